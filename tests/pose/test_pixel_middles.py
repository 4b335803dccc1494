"""Pictures that hold the path at the middle of each pixel: right geometry is left alone."""

import dataclasses

import numpy as np
import pytest

from gcar_deploy.config import PoseOptions, RunOptions
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.consistency import chequered, mismatch, sampling_noise, vessel_mass
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.pose.agreement import poses_between


def view(primary, secondary, size=256):
    return CArm(
        primary_angle_deg=primary, secondary_angle_deg=secondary, sod_mm=765, sdd_mm=1080,
        rows=size, columns=size, pixel_spacing_mm=(200 / size, 200 / size),
    )  # fmt: skip


def beads(rng):
    """Centres, mm, and radii of spheres along a bent line; they do not touch."""
    t = np.linspace(-1, 1, 16)
    bend = rng.normal(0, 12, 3)
    line = (
        np.outer(t, rng.normal(0, 18, 3))
        + np.outer(t**2, bend)
        + np.outer(t**3, rng.normal(0, 9, 3))
    )
    return line, rng.uniform(0.7, 1.1, len(t))


def picture(carm, centres, radii):
    """(rows, cols) chords of the rays through the pixels' middles."""
    (col, row), out = np.meshgrid(np.arange(carm.columns), np.arange(carm.rows)), 0.0
    x = (col - carm.principal_point[0]) / carm.focal_px[0]
    y = (row - carm.principal_point[1]) / carm.focal_px[1]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.asarray(carm.axes)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for centre, radius in zip(centres, radii, strict=True):
        to = centre - carm.source_mm
        off = to @ to - (rays @ to) ** 2
        out = out + 2 * np.sqrt(np.maximum(radius**2 - off, 0))
    return out.astype(np.float32)


def seen(carms, tree):
    scale = Intensity(kind="path_length", polarity="bright", mm_per_count=1.0)
    return [
        extract_vessels(
            Angiogram(
                view_id=str(k), carm=carm, pixels=picture(carm, *tree), bit_depth=32,
                intensity=scale, sha256=str(k),
            ),
            RunOptions().imaging,
        )
        for k, carm in enumerate(carms)
    ]  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_right_geometry_is_left_alone(seed):
    rng = np.random.default_rng(seed)
    carms = view(rng.uniform(-60, 0), rng.uniform(-25, 25)), view(40, rng.uniform(-25, 25))
    poses = poses_between(seen(carms, beads(rng)), RunOptions())
    assert not poses[1].theta.any(), (poses[1].before, poses[1].after)


@pytest.mark.parametrize("seed", range(4))
def test_a_patient_who_moved_is_seen_all_the_same(seed):
    rng = np.random.default_rng(seed)
    told = view(-30, 10), view(50, -15)
    across = np.cross(told[0].source_mm, told[1].source_mm)
    moved = told[0], told[1].moved(3 * across / np.linalg.norm(across))
    tree = beads(rng)
    views = [dataclasses.replace(v, carm=c) for v, c in zip(seen(moved, tree), told, strict=True)]
    pose = poses_between(views, RunOptions())[1]
    assert pose.after < 0.3 * pose.before and pose.shift_mm > 1.5


def test_the_mismatch_of_pixels_alone_is_told_from_the_pictures():
    told, fine = [], PoseOptions().fine_mm
    for seed in range(12):
        rng = np.random.default_rng(seed)
        carms = view(-30, rng.uniform(-25, 25)), view(50, rng.uniform(-25, 25))
        tree = beads(rng)
        masses = [
            vessel_mass(carm, path, True, grain=chequered(path))
            for carm in carms
            for path in [picture(carm, *tree)]
        ]
        noise = sampling_noise(*masses, carms[1], fine)
        told.append(mismatch(*masses, carms[1], fine) / noise)
    assert 0.3 < np.exp(np.mean(np.log(told))) < 1.5 and max(told) < 3
    without = [dataclasses.replace(mass, grain=None) for mass in masses]
    assert sampling_noise(*without, carms[1], fine) == 0
