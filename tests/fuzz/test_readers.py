"""Fuzzing of every reader: a short run with the other tests, a longer one marked slow, and `make fuzz`."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.targets import TARGETS, mutated, starts


def fuzz(name: str, inputs: int) -> None:
    @settings(
        max_examples=inputs, deadline=60_000, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    @given(mutated(name))
    def check(content: bytes) -> None:
        TARGETS[name].read(content)

    check()


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_that_once_went_wrong(name):
    for content in starts(name):
        TARGETS[name].read(content)


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_are_read_or_give_one_sentence(name):
    fuzz(name, 60)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_many_mutated_inputs_are_read_or_give_one_sentence(name):
    fuzz(name, 1000)


@given(st.binary(max_size=300))
@settings(max_examples=30, deadline=60_000, database=None, derandomize=True)
def test_noise_gives_one_sentence(content):
    for target in TARGETS.values():
        target.read(content)
