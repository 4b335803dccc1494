"""Pairs of frames: scores against a slow twin, and runs whose phase is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gcar_deploy.frames.choose import SeenRun, choose_frames
from gcar_deploy.frames.masses import RunMasses
from gcar_deploy.frames.pairs import along_diagonals, choose_pair
from gcar_deploy.geometry.carm import CArm
from gcar_export.scenes.cine import cine_pair
from gcar_export.studies.frame_pairs import CHOSEN_ON, judged, rows, seen_run

FRAMES = 12


def view(primary: float) -> CArm:
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=15.0, sod_mm=750, sdd_mm=1050,
        rows=128, columns=128, pixel_spacing_mm=(1.2, 1.2),
    )  # fmt: skip


def dots(carm: CArm, phases: np.ndarray, shift_mm: tuple[float, float, float]) -> RunMasses:
    """Blobs that swing, each by its own way: no tree, no drawing of the project."""
    rng = np.random.default_rng(3)
    home, cosine, sine = (s * rng.normal(size=(14, 3)) for s in (18.0, 5.0, 5.0))
    row, col = np.mgrid[0:128, 0:128]
    masses = []
    for phase in phases:
        t = 2 * np.pi * phase
        points = home + np.cos(t) * cosine + np.sin(t) * sine + np.array(shift_mm)
        at = carm.project(points)[0]
        masses.append(sum(
            np.exp(-0.5 * ((col - c) ** 2 + (row - r) ** 2) / 2.0) for c, r in at
        ))  # fmt: skip
    n = len(phases)
    return RunMasses(
        carm=carm, masses=np.array(masses, dtype=np.float32), filling=np.ones(n),
        motion=np.linspace(0.1, 0.2, n), beats=True,
    )  # fmt: skip


def beating(offset: float, rate: float = 1 / 6) -> np.ndarray:
    return offset + rate * np.arange(FRAMES)


def wrapped(a: float, b: float) -> float:
    apart = abs(a - b) % 1.0
    return min(apart, 1 - apart)


def test_diagonals_are_means_of_the_frames_before_and_after():
    scores = np.random.default_rng(1).normal(size=(6, 9))
    found = along_diagonals(scores, 1.0)
    for i in range(6):
        for j in range(9):
            own = [
                (1 - abs(k) / 4, scores[i + k, j + k])
                for k in range(-3, 4)
                if 0 <= i + k < 6 and 0 <= j + k < 9
            ]
            mean = sum(w * s for w, s in own) / sum(w for w, _ in own)
            assert found[i, j] == pytest.approx(mean)


@pytest.mark.parametrize("shift", [(0, 0, 0), (4.0, -3.0, 6.0)])
@pytest.mark.parametrize("offset", [0.0, 0.36, 0.7])
def test_the_pair_shows_one_phase_wherever_the_patient_lies(offset, shift):
    phases = beating(0.1), beating(0.1 + offset)
    pair = choose_pair(dots(view(-30), phases[0], (0, 0, 0)), dots(view(50), phases[1], shift))
    i, j = pair.chosen
    assert wrapped(phases[0][i], phases[1][j]) < 1 / 12  # half a frame
    assert pair.margin is not None and pair.margin > 0.1
    assert pair.remaining[i, j] and pair.score == pair.scores[pair.remaining].max()


def test_frame_times_tell_how_the_runs_go_along():
    phases = beating(0.0), beating(0.3, 1 / 12)
    first, second = dots(view(-30), phases[0], (0, 0, 0)), dots(view(50), phases[1], (0, 0, 0))
    i, j = choose_pair(first, second, ratio=2.0).chosen
    assert wrapped(phases[0][i], phases[1][j]) < 1 / 12


def test_a_frame_that_is_asked_for_is_kept():
    first, second = (dots(view(a), beating(o), (0, 0, 0)) for a, o in ((-30, 0.0), (50, 0.5)))
    for asked in range(3, 9):
        pair = choose_pair(first, second, wanted=(None, asked))
        assert pair.chosen[1] == asked
        assert wrapped(beating(0.0)[pair.chosen[0]], beating(0.5)[asked]) < 1 / 12


def test_r_waves_go_first_where_both_runs_have_them():
    first, second = (dots(view(a), beating(o), (0, 0, 0)) for a, o in ((-30, 0.0), (50, 0.5)))
    pair = choose_pair(first, second, r_waves=([2, 8], [5, 11]))
    assert pair.chosen[0] in (2, 8) and pair.chosen[1] in (5, 11)
    assert choose_pair(first, second, r_waves=([2, 8], [])).remaining.sum() > 4
    # An R wave before the contrast is none to take.
    empty = dataclasses.replace(first, filling=np.where(np.arange(FRAMES) == 2, 0.1, 1.0))
    assert choose_pair(empty, second, r_waves=([2, 8], [5])).chosen == (8, 5)


def test_empty_frames_and_the_fastest_are_left_out():
    first, second = (dots(view(a), beating(0.0), (0, 0, 0)) for a in (-30, 50))
    filling = np.ones(FRAMES)
    filling[:4] = 0.3
    pair = choose_pair(dataclasses.replace(first, filling=filling), second)
    assert not pair.remaining[:4].any()
    assert not pair.remaining[:, -3:].any()  # these move most


def test_runs_at_rest_choose_no_pair():
    made = cine_pair(CHOSEN_ON, 3, frames=5)
    runs = {}
    for k, run in enumerate(made.runs, start=1):
        still = dataclasses.replace(run, pixels=run.pixels[2:3].repeat(5, axis=0))
        runs[k] = seen_run(still)
    assert choose_frames(runs, {1: None, 2: None}) == {}


@pytest.mark.slow
def test_a_generated_patient_within_a_frame():
    row = judged(cine_pair(CHOSEN_ON, 3))
    assert row.error_frames <= 1.0
    assert row.margin is not None and row.margin > 0.03


@pytest.mark.slow
def test_a_third_run_follows_the_first():
    made = cine_pair(CHOSEN_ON, 3)
    first, second = (seen_run(run) for run in made.runs)
    told: dict[int, SeenRun] = {1: first, 2: second, 3: second}
    found = choose_frames(told, {1: None, 2: None, 3: None})
    assert found[3].number == found[2].number and found[3].partner == 1
    assert choose_frames(told, {1: 3, 2: 4, 3: 5}) == {}


@pytest.mark.slow
def test_nine_of_ten_generated_patients_within_a_frame():
    found = [row.error_frames <= 1.0 for row in rows(CHOSEN_ON + 1, 10)]
    assert sum(found) >= 9
