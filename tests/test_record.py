"""What is known about a separation is carried over as it is, also if a value is 0 or empty."""

import json
from dataclasses import fields

import pytest

from brewster.batch import FileResult
from brewster.separation.assessment import Assessment
from brewster.separation.burst_report import BurstReport
from brewster.separation.record import SeparationRecord

NOTHING = SeparationRecord(
    model="",
    device="cpu",
    seconds={"decode": 0.123456},
    residual=0.0,
    reconstruction_error=0.0,
    assessment=Assessment("little found", 0.0, 0.0, 1.0),
    reflection_is_derived=True,
    burst=BurstReport("unchanged", "", 0, (), 0, 0.0, 0.0, 0.0),
    note="",
)


def test_a_result_takes_over_all_values_that_are_known():
    result = FileResult("a.jpg", model="before", photo_sha256="0" * 64, next_step="before")
    result.enter(NOTHING)
    known = {"photo_sha256": "0" * 64, "next_step": "before"}
    for field in fields(SeparationRecord):
        expected = known.get(field.name, getattr(NOTHING, field.name))
        assert getattr(result, field.name) == expected
    assert result.source == "a.jpg"


def test_json_has_the_same_names_and_values_with_or_without_a_file():
    result = FileResult("a.jpg")
    result.enter(NOTHING)
    values = json.loads(json.dumps(result.as_dict()))
    expected = json.loads(json.dumps(NOTHING.as_dict()))
    assert {name: values[name] for name in expected} == expected
    assert [*values][:3] == ["source", "status", "outputs"]
    assert values["seconds"] == {"decode": pytest.approx(0.1235, abs=1e-9)}
