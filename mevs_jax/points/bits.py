"""Bit strings in 32-bit words: finds the s-th set bit for many s at once, without a pass over all bits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

WORD = 32
"""Bits per word."""


def bits_until(words: UInt32[Array, " words"]) -> Int[Array, " words"]:
    """Number of set bits up to the end of each word."""
    # On CPU, the associative scan is twice as fast as cumsum.
    return jax.lax.associative_scan(jnp.add, jax.lax.population_count(words).astype(jnp.int32))


def set_bits(words: UInt32[Array, " words"], until: Int[Array, " words"], ranks: Int[Array, " k"]) -> Int[Array, " k"]:
    """Positions of the set bits of the given ranks; the position is arbitrary for a rank without a bit.

    A search in `until` finds the word of a bit, and five halvings find the bit inside the word.

    Args:
        words: the bit string, lowest bit first.
        until: `bits_until(words)`.
        ranks: of the bits among the set bits, from 0.
    """
    word = _first_above(until, ranks)
    before = until[word] - jax.lax.population_count(words[word]).astype(jnp.int32)
    return word * WORD + select_bit(words[word], ranks - before)


def _first_above(rising: Int[Array, " n"], values: Int[Array, " k"]) -> Int[Array, " k"]:
    """For each value, the first index at which `rising` exceeds it, at most n − 1.

    Comparisons with the ends of about sixteen blocks find the block, and bisection finds the index inside it. Bisection alone
    would gather at every halving, and a CPU gathers one element at a time.
    """
    count = rising.shape[0]
    block = max(8, 1 << (count // 16).bit_length() - 1) if count >= 16 else 1 << count.bit_length()
    ends = [rising[end] for end in range(block - 1, count, block)]
    found = block * sum(((end <= values).astype(jnp.int32) for end in ends), jnp.zeros_like(values))
    while block := block // 2:
        below = rising[jnp.minimum(found + block, count) - 1] <= values
        found = jnp.where(below, found + block, found)
    return jnp.minimum(found, count - 1)


def select_bit(word: UInt32[Array, "*slots"], rank: Int[Array, "*slots"]) -> Int[Array, "*slots"]:
    """Position of the set bit of each word with the given rank (from 0), by halving."""
    position = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        low = word & jnp.uint32((1 << width) - 1)
        ones = jax.lax.population_count(low).astype(jnp.int32)
        above = rank >= ones
        rank = jnp.where(above, rank - ones, rank)
        position = jnp.where(above, position + width, position)
        word = jnp.where(above, word >> width, low)
    return position
