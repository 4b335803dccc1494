"""Odd option values end in one line or in a result, never in an internal error."""

from __future__ import annotations

import dataclasses
import math
import typing
import warnings
from typing import Annotated

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gcar_deploy.config import PredictOptions, RunOptions, check_options
from gcar_deploy.config.ranges import Range
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.inspection import inspect_files
from gcar_deploy.selftest import tiny_case

#: branches of the options whose values reach a reconstruction of pictures in memory
_USED = ("imaging", "pose", "candidates", "predict", "refine", "quality")
_ODD = (
    0, 1, -1, 2, 5, 0.5, 1e-9, 1e9, -1e9, 10**12, math.inf, -math.inf, math.nan, True, None,
    "x", "", (), (0,), (1.0, 2.0), (None,), [1], b"", 1j,
)  # fmt: skip


def fields(options, name=""):
    """Yield (path, value, range or None) of every field of nested options."""
    hints = typing.get_type_hints(type(options), include_extras=True)
    for field in dataclasses.fields(options):
        value, path = getattr(options, field.name), f"{name}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from fields(value, f"{path}.")
        else:
            yield path, value, ranges_in(hints[field.name])


def ranges_in(hint):
    if typing.get_origin(hint) is Annotated:
        return typing.get_args(hint)[1]
    found = [ranges_in(part) for part in typing.get_args(hint)]
    return next((rule for rule in found if rule is not None), None)


def changed(options, path, value):
    head, _, rest = path.partition(".")
    new = changed(getattr(options, head), rest, value) if rest else value
    return dataclasses.replace(options, **{head: new})


FIELDS = {path: (value, rule) for path, value, rule in fields(RunOptions())}
CASE = tiny_case()[:2]
HULL = RunOptions(predict=PredictOptions(predictor="none"))


def one_line_or_result(path, value):
    """Reconstruct the tiny case; an error that the project raises on purpose is one line."""
    learned = path.startswith(("predict.", "candidates."))
    base = changed(RunOptions(), "predict.predictor", "multi" if learned else "none")
    if path.startswith("refine.paper."):
        base = changed(base, "refine.refiner", "paper")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # divided by zero, left the numbers
        try:
            Engine(options=changed(base, path, value), threads=1).reconstruct(*CASE, deadline_s=5.0)
        except GcarError as error:
            assert len(str(error).splitlines()) == 1, str(error)


def test_every_number_has_its_range_and_every_default_lies_in_it():
    check_options(RunOptions())
    for path, (value, rule) in FIELDS.items():
        numbers = value if isinstance(value, tuple) else (value,)
        if path != "landmarks" and any(type(number) in (int, float) for number in numbers):
            assert isinstance(rule, Range), path


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("predict.lattices", 5, "predict.lattices = 5 must be a whole number, 1 .. 4"),
        ("predict.lattices", 2.5, "predict.lattices = 2.5 must be a whole number, 1 .. 4"),
        ("predict.lattices", True, "predict.lattices = True must be a whole number, 1 .. 4"),
        ("quality.good_coverage", math.nan, "good_coverage = nan must be a number, 0 .. 1"),
        ("refine.tube.steps", (), "refine.tube.steps = () must be a tuple of 1 or more values"),
        ("refine.tube.steps", (3,), "refine.tube.steps must be as many as levels_mm"),
        ("refine.tube.steps", (3, -1), "refine.tube.steps = -1 must be a whole number, 0 .. "),
        ("pose.enabled", 1, "pose.enabled = 1 must be True or False"),
        ("predict", None, "predict = None must be PredictOptions"),
        ("predict.predictor", 7, "predictor = 7 must be one of auto, multi, paper, none"),
        ("imaging.segmenter", "Net", "segmenter = 'Net' must be one of auto, classic, net"),
    ],
)
def test_the_message_names_option_value_and_range(path, value, said, tmp_path):
    options = changed(RunOptions(), path, value)
    with pytest.raises(UsageError) as refused:
        Engine(options=options)
    assert said in str(refused.value)
    assert inspect_files([tmp_path / "a", tmp_path / "b"], None, options).error.exit_code == 2


@pytest.mark.parametrize("value", [0, -1, 257, 10**400, 2.5, math.nan, math.inf, "2", True, [1]])
def test_threads_and_deadline(value):
    with pytest.raises(UsageError, match=r"^threads = .* must be a whole number, 1 \.\. 256$"):
        Engine(options=HULL, threads=value)
    if value not in (257, 2.5):
        with pytest.raises(UsageError, match=r"^deadline_s = .* must be a number, "):
            Engine(options=HULL, threads=1).reconstruct(*CASE, deadline_s=value)


def test_numbers_of_other_libraries_are_numbers():
    np = pytest.importorskip("numpy")
    check_options(PredictOptions(lattices=np.int64(3), max_cell_mm=np.float32(1.5)))


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(path=st.sampled_from([p for p in FIELDS if p.startswith(_USED)]), data=st.data())
def test_odd_values_give_one_line_or_a_result(path, data):
    rule = FIELDS[path][1]
    odd = st.sampled_from(_ODD)
    if rule is not None:
        inside = st.one_of(
            st.sampled_from([rule.least, rule.most]), st.floats(rule.least, rule.most)
        )
        whole = inside.map(lambda x: round(x))
        odd = st.one_of(odd, inside, whole, whole.map(lambda x: (x,)), inside.map(lambda x: (x,)))
    one_line_or_result(path, data.draw(odd))
