"""Long bit strings in words of 32: where the s-th set bit is, for many s at once, without looking at every bit again."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

WORD = 32


def bits_until(words: UInt32[Array, " words"]) -> Int[Array, " words"]:
    """How many bits are set up to the end of each word."""
    # On CPU twice as fast as cumsum.
    return jax.lax.associative_scan(jnp.add, jax.lax.population_count(words).astype(jnp.int32))


def set_bits(words: UInt32[Array, " words"], until: Int[Array, " words"], ranks: Int[Array, " k"]) -> Int[Array, " k"]:
    """Positions of the set bits of some ranks, counted from 0; a rank that no bit has gives any position.

    Args:
        until: `bits_until(words)`: it says which word holds a bit, and five halvings find it inside the word.
    """
    word = _first_above(until, ranks)
    before = until[word] - jax.lax.population_count(words[word]).astype(jnp.int32)
    return word * WORD + _select_bit(words[word], ranks - before)


def _first_above(rising: Int[Array, " n"], values: Int[Array, " k"]) -> Int[Array, " k"]:
    """For each value the first index of `rising` that exceeds it, at most n − 1.

    Comparing with the ends of some sixteen blocks, one after the other, says which block, and bisection where in it: bisection
    alone gathers at every halving, which CPUs do one by one.
    """
    count = rising.shape[0]
    block = max(8, 1 << (count // 16).bit_length() - 1) if count >= 16 else 1 << count.bit_length()
    ends = [rising[end] for end in range(block - 1, count, block)]
    found = block * sum(((end <= values).astype(jnp.int32) for end in ends), jnp.zeros_like(values))
    while block := block // 2:
        below = rising[jnp.minimum(found + block, count) - 1] <= values
        found = jnp.where(below, found + block, found)
    return jnp.minimum(found, count - 1)


def _select_bit(word: UInt32[Array, " k"], rank: Int[Array, " k"]) -> Int[Array, " k"]:
    """Position of the set bit number `rank` (from 0) of each word, by halving."""
    position = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        low = word & jnp.uint32((1 << width) - 1)
        ones = jax.lax.population_count(low).astype(jnp.int32)
        above = rank >= ones
        rank = jnp.where(above, rank - ones, rank)
        position = jnp.where(above, position + width, position)
        word = jnp.where(above, word >> width, low)
    return position
