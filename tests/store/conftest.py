"""Fixtures of the store's tests."""

import os
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module")
def no_flush() -> Iterator[None]:
    """Nothing is flushed to the disk: for tests that crash nothing, it takes most of their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield
