"""What is written as TOML is read back as it was."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sipe_bayes.core.toml import to_toml

PLAIN = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text()
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=8)
TABLES = st.dictionaries(st.text(), VALUES, max_size=4)
DOCUMENTS = st.dictionaries(st.text(), VALUES | TABLES | st.lists(TABLES, max_size=3), max_size=5)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(DOCUMENTS)
def test_any_document_comes_back(document: dict[str, object]) -> None:
    assert tomllib.loads(to_toml(document)) == document


def test_tables_stand_apart_and_are_read_by_people() -> None:
    text = to_toml({"logs": [{"file": "a.csv"}, {"file": "b.csv"}], "seed": 1, "noise": {"model": "ar1"}})
    assert text == 'seed = 1\n\n[[logs]]\nfile = "a.csv"\n\n[[logs]]\nfile = "b.csv"\n\n[noise]\nmodel = "ar1"\n'


@pytest.mark.parametrize("value", [None, object(), b"bytes"])
def test_what_toml_has_no_word_for_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match="TOML has no word"):
        to_toml({"key": value})
