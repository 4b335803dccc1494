"""Limits are written down, and can be changed by whoever knows where the files come from."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from gcar_deploy.config import (
    DicomLimits,
    ModelLimits,
    PictureLimits,
    PredictOptions,
    RunOptions,
)
from gcar_deploy.engine import Engine
from gcar_deploy.errors import ModelError

TEXT = (Path(__file__).parents[1] / "docs" / "limits.md").read_text(encoding="utf-8")


@pytest.mark.req("REQ-49")
@pytest.mark.parametrize("limits", [PictureLimits, DicomLimits, ModelLimits])
def test_every_limit_is_in_the_table(limits):
    row = re.findall(rf"`{limits.__name__}\.(\w+)`((?:, `\w+`)*)", TEXT)
    named = {name for first, more in row for name in (first, *re.findall(r"\w+", more))}
    assert named >= {field.name for field in dataclasses.fields(limits)}


@pytest.mark.req("REQ-49")
def test_every_limit_of_the_table_can_be_changed():
    known = {limits.__name__: limits for limits in (PictureLimits, DicomLimits, ModelLimits)}
    named = re.findall(r"`(\w+Limits)\.(\w+)`((?:, `\w+`)*)", TEXT)
    assert len(named) > 5
    for limits, first, more in named:
        for name in (first, *re.findall(r"\w+", more)):
            assert name in known[limits].__dataclass_fields__, f"docs/limits.md: {limits}.{name}"


@pytest.mark.req("REQ-49")
def test_an_engine_with_other_limits_refuses_by_them():
    tight = PredictOptions(limits=ModelLimits(max_nodes=1))
    with pytest.raises(ModelError, match="more than 1 nodes"):
        Engine(options=RunOptions(predict=tight))
