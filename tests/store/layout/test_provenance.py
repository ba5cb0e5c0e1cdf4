"""The identity of results: what changes a recipe id and what does not, headers, histories, digests."""

import dataclasses
import functools
import json
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.resources import schemas
from evetac_cli.store.layout.provenance import (
    ContentDigest,
    Header,
    Recipe,
    canonical,
    content_digest,
    first_difference,
    folded,
    history_fault,
    recompute_id,
    unfolded,
)

PARENT = Recipe("recording", 1, {"object": 3}, seed=1).header()
OTHER_PARENT = Recipe("recording", 1, {"object": 4}, seed=1).header()
BASE = Recipe(
    kind="tracks",
    method=2,
    parameters={"preset": "paper", "constants": {"alpha": 0.5, "n": 3}},
    seed=7,
    parents=(PARENT,),
    content="c" * 64,
)
CHANGES: dict[str, dict[str, Any]] = {
    "kind": {"kind": "labels"},
    "method": {"method": 3},
    "a value": {"parameters": {"preset": "carry", "constants": {"alpha": 0.5, "n": 3}}},
    "a nested value": {"parameters": {"preset": "paper", "constants": {"alpha": 0.5000000000000001, "n": 3}}},
    "a type": {"parameters": {"preset": "paper", "constants": {"alpha": 0.5, "n": 3.0}}},
    "a key more": {"parameters": {"preset": "paper", "constants": {"alpha": 0.5, "n": 3}, "more": None}},
    "a key less": {"parameters": {"preset": "paper"}},
    "seed": {"seed": 8},
    "no seed": {"seed": None},
    "content": {"content": "d" * 64},
    "no content": {"content": None},
    "another parent": {"parents": (OTHER_PARENT,)},
    "a parent more": {"parents": (PARENT, OTHER_PARENT)},
    "no parent": {"parents": ()},
}


def test_ids_are_all_different() -> None:
    """Assert that no two of these recipes share an id, and that parents count in their order."""
    recipes = [dataclasses.replace(BASE, **change) for change in CHANGES.values()]
    recipes += [BASE, dataclasses.replace(BASE, parents=(OTHER_PARENT, PARENT))]
    assert len({recipe.id for recipe in recipes}) == len(recipes)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)
parameters = st.dictionaries(st.text(max_size=4), values, max_size=5)


def backwards(value: Any) -> Any:
    """The same value with the keys of every dict in the other order."""
    if isinstance(value, dict):
        return {key: backwards(value[key]) for key in reversed(value)}
    if isinstance(value, list):
        return [backwards(item) for item in value]
    return value


@given(parameters)
@settings(max_examples=60, deadline=None)
def test_order_of_keys_is_no_part_of_the_id(table: dict[str, Any]) -> None:
    """Assert that the same parameters in another order, or read back from JSON, have the same id."""
    recipe = Recipe("tracks", 1, table)
    assert Recipe("tracks", 1, backwards(table)).id == recipe.id
    assert Recipe("tracks", 1, json.loads(json.dumps(table))).id == recipe.id


@given(parameters, parameters)
@settings(max_examples=60, deadline=None)
def test_first_difference_is_found_wherever_it_is(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Assert that recipes with different ids have a difference in words, and that equal ones have none."""
    wanted, existing = Recipe("tracks", 1, ours), Recipe("tracks", 1, theirs)
    words = first_difference(wanted, existing.header())
    assert (words == "the schema version differs") == (wanted.id == existing.id)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {"deep": [1, -float("inf")]}])
def test_what_is_no_json_has_no_id(value: object) -> None:
    """Assert that NaN and infinity are refused, as no JSON reader would agree on them."""
    with pytest.raises(ValueError, match="JSON"):
        _ = Recipe("tracks", 1, {"value": value}).id


def test_time_host_and_versions_are_no_part_of_the_id(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the id of a header stays the same when it is made elsewhere at another time."""
    here = BASE.header()
    monkeypatch.setattr(
        "evetac_cli.store.layout.provenance.time_host_versions", lambda: {"at": "tomorrow", "host": "elsewhere"}
    )
    elsewhere = BASE.header()
    assert here["made"] != elsewhere["made"]
    assert here["id"] == elsewhere["id"] == BASE.id


def test_header_is_as_its_schema_says() -> None:
    """Assert that headers with and without parents are valid, and the same after a journey through JSON."""
    rules = jsonschema.Draft202012Validator(json.loads((schemas() / "header.v1.json").read_text()))
    for header in (PARENT, BASE.header(), Recipe("report", 1, {}).header()):
        rules.validate(header)
        assert json.loads(json.dumps(header)) == header


EDITS: dict[str, Any] = {
    "kind": "labels",
    "version": "2.0",
    "method": 9,
    "parameters": {},
    "seed": 0,
    "parents": [],
    "content": None,
}


@pytest.mark.parametrize(("key", "value"), EDITS.items())
def test_edits_are_detected(key: str, value: object) -> None:
    """Assert that the id no longer fits a header in which something was edited."""
    header = BASE.header()
    assert recompute_id(header) == header["id"] == BASE.id
    assert recompute_id({**header, key: value}) != header["id"]


def test_a_newer_minor_version_has_the_same_id() -> None:
    """Assert that a minor version is no part of the id, as it only adds."""
    header = BASE.header()
    assert recompute_id({**header, "version": "1.7"}) == header["id"]


def test_history_carries_every_ancestor_once() -> None:
    """Assert that where two ways lead back to one recording, it stands in the history once, with all others."""
    recording = Recipe("recording", 1, {}, seed=1, simulated_source=True)
    tracks = Recipe("tracks", 1, {}, parents=(recording.header(),))
    labels = Recipe("labels", 1, {}, parents=(recording.header(),))
    features = Recipe("features", 1, {}, parents=(recording.header(), tracks.header(), labels.header()))
    header = Recipe("report", 1, {}, seed=3, parents=(features.header(),)).header()
    assert list(header["history"]) == [recording.id, tracks.id, labels.id, features.id]
    assert header["parents"] == [features.id]
    for id_, ancestor in header["history"].items():
        assert ancestor["id"] == id_ == recompute_id(ancestor)
        assert set(ancestor) == set(header) - {"history", "made"}
        assert set(ancestor["parents"]) <= set(header["history"])


def test_simulated_is_inherited() -> None:
    """Assert that one simulated ancestor makes a result simulated, and none leaves it real."""
    real, simulated = (Recipe("recording", 1, {"real": real}, simulated_source=not real) for real in (True, False))
    assert not Recipe("tracks", 1, {}, parents=(real.header(),)).header()["simulated"]
    mixed = Recipe("tracks", 1, {}, parents=(real.header(), simulated.header())).header()
    assert mixed["simulated"]
    assert Recipe("features", 1, {}, parents=(mixed,)).header()["simulated"]


def test_canonical_json() -> None:
    """Assert the very bytes that ids are made of, because a change would make every file another's."""
    assert canonical({"b": [1, 1.0, None], "a": {"ä": True}}) == '{"a":{"\\u00e4":true},"b":[1,1.0,null]}'


@given(
    st.lists(st.integers(-(2**62), 2**62), max_size=30),
    st.lists(st.integers(0, 30), max_size=6),
    st.sampled_from([np.int64, np.float64]),
)
@settings(max_examples=60, deadline=None)
def test_content_digest_does_not_depend_on_the_cut(numbers: list[int], cuts: list[int], dtype: type) -> None:
    """Assert that an array in pieces, empty ones among them, has the digest of the whole."""
    column = np.array(numbers, dtype)
    digest = ContentDigest()
    for piece in np.split(column, sorted(min(cut, len(column)) for cut in cuts)):
        digest.update("events/t", piece)
        digest.update("events/xy", np.stack([piece, piece], axis=1))
    whole = {"events/xy": np.stack([column, column], axis=1), "events/t": column}
    assert digest.hexdigest() == content_digest(whole)


DIFFERENT: dict[str, dict[str, Any]] = {
    "value": {"a": np.array([[1, 2, 3], [4, 5, 7]], np.int32)},
    "shape": {"a": np.array([[1, 2], [3, 4], [5, 6]], np.int32)},
    "flat": {"a": np.array([1, 2, 3, 4, 5, 6], np.int32)},
    "dtype": {"a": np.array([[1, 2, 3], [4, 5, 6]], np.uint32)},
    "name": {"b": np.array([[1, 2, 3], [4, 5, 6]], np.int32)},
    "one more": {"a": np.array([[1, 2, 3], [4, 5, 6]], np.int32), "b": np.empty(0)},
    "none": {},
    "text": {"a": "1"},
    "the same bytes": {"a": np.frombuffer(b"1", np.uint8)},
    "a scalar of the same bytes": {"a": np.uint8(ord("1"))},
}


def test_content_digest_tells_arrays_apart() -> None:
    """Assert that value, shape, dtype, name and number of arrays all count, and text is not its bytes."""
    base = {"a": np.array([[1, 2, 3], [4, 5, 6]], np.int32)}
    digests = [content_digest(arrays) for arrays in (base, *DIFFERENT.values())]
    assert len(set(digests)) == len(digests)


HEADER = Recipe("report", 1, {"a": 1}).header()


@pytest.mark.parametrize(
    "change",
    [
        *({key: ...} for key in ("version", "parents")),
        {"version": "9" * 5000 + ".1"},
        {"parameters": {"a": float("nan")}},
        {"parameters": functools.reduce(lambda inner, _: [inner], range(100_000), [])},
    ],
    ids=lambda change: str(change)[:30] if "parameters" not in change else "parameters",
)
def test_m4_a_header_without_an_identity_has_no_id(change: dict[str, Any]) -> None:
    """Assert that a header, or an ancestor in it, that lacks what an id is made of has none, and nothing is raised."""
    header = {key: value for key, value in {**HEADER, **change}.items() if value is not ...}
    assert recompute_id(header) == ""
    assert recompute_id(HEADER) == HEADER["id"]


def family(recordings: int) -> Header:
    """The header of a report on recordings that have their scene in common, and the numbers of some sensors."""
    scene = {"name": "slip", "time": {"rest_s": 0.2, "load_s": 0.5}, "summary": "an object slips out of the grip"}
    rows = [{"seed": row, "dots": list(range(100))} for row in range(2)]
    made = [
        Recipe("recording", 1, {"scene": scene, "row": rows[number % 2], "trial": number}, seed=number).header()
        for number in range(recordings)
    ]
    return Recipe("report", 1, {"scene": scene}, parents=tuple(made)).header()


def as_stored(header: Header) -> Header:
    """What is read of a header that was written."""
    stored: Header = json.loads(canonical(folded(header)))
    return stored


def test_what_ancestors_share_stands_once_in_a_file() -> None:
    """Assert that a header comes back whole with ids that fit, and is shorter in a file, where something is shared."""
    header = family(20)
    stored = as_stored(header)
    assert header == family(20) | {"made": header["made"]}  # folding changes nothing in it
    assert len(stored["shared"]) == 3
    assert {frozenset(one["parameters"]) for one in stored["history"].values()} == {frozenset(["trial"])}
    assert len(canonical(stored)) < 0.6 * len(canonical(header))
    jsonschema.validate(stored, json.loads((schemas() / "header.v1.json").read_text()))
    whole = unfolded(stored, 10**5)
    assert whole == header
    assert history_fault(whole) == ""
    for alone in (family(1), PARENT, BASE.header()):
        assert folded(alone) == alone == unfolded(as_stored(alone), 0)


def test_headers_whose_shared_parameters_do_not_fit() -> None:
    """Assert that places that are not there, other types and too much are refused, and that sharing nothing is not."""
    whole = family(4)

    def broken(**changes: Any) -> Header:
        stored = as_stored(whole)
        next(iter(stored["history"].values())).update(changes)
        return stored

    for stored in (broken(shared="scene"), broken(shared={"scene": 3}), as_stored(whole) | {"shared": {}}):
        with pytest.raises((AttributeError, LookupError, TypeError)):
            unfolded(stored, 10**5)
    with pytest.raises(ValueError, match="too long"):
        unfolded(as_stored(whole), 1000)
