"""Users' own label volumes in training: read, thinned, trained on, and remembered."""

import dataclasses
import json

import nibabel
import numpy as np
import pytest
from scipy.spatial import cKDTree

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_export.scenes.capsules import Capsules
from gcar_export.scenes.label_trees import capsules_of, label_tree, read_label_trees
from gcar_export.scenes.labels import LabelVolume, read_label
from gcar_export.scenes.raycast import raycast
from gcar_export.scenes.render import occupancy, path_lengths
from gcar_export.training import multi as train_multi
from gcar_export.training import paper as train_paper
from gcar_export.training.dataset import training_scene
from gcar_export.training.examinations import SceneOptions
from gcar_export.training.paper_dataset import training_pictures
from gcar_export.training.train import start


def _helix(radius=18.0, turns=1.6, n=260):
    t = np.linspace(0, 2 * np.pi * turns, n)
    return np.stack([radius * np.cos(t), radius * np.sin(t), 7 * t - 30], axis=1)


def _volume(tube=1.8, spacing=0.8):
    """A helical vessel, 96^3 voxels, as a mask."""
    index = np.argwhere(np.ones((96, 96, 96), bool))
    points = (index - 47.5) * spacing
    off = cKDTree(_helix()).query(points, distance_upper_bound=tube)[0]
    return np.isfinite(off).reshape(96, 96, 96)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("labels")
    affine = np.diag([-0.8, -0.8, 0.8, 1.0])
    affine[:3, 3] = [38, 38, -38]
    nibabel.save(nibabel.Nifti1Image(_volume().astype(np.uint8), affine), out / "a.nii.gz")
    data = np.asfortranarray(_volume(tube=2.2).astype(np.uint8)).tobytes(order="F")
    header = (
        "ObjectType = Image\nNDims = 3\nDimSize = 96 96 96\nElementType = MET_UCHAR\n"
        "ElementSpacing = 0.8 0.8 0.8\nElementDataFile = LOCAL\n"
    )
    (out / "b.mha").write_bytes(header.encode() + data)
    (out / "notes.txt").write_text("not a volume")
    return out


def test_capsules_follow_the_vessel_with_its_radius(folder):
    label = read_label(folder / "a.nii.gz")
    made = capsules_of(label)
    low, high = label.box_mm()
    assert isinstance(made, Capsules) and len(made.radii) > 150
    assert np.median(made.radii) == pytest.approx(1.8, abs=0.25)
    # Volume and projection of the capsules are those of the mask.
    index = np.argwhere(label.occupancy > -1)
    points = label.grid.index2world(index)
    share, _, _ = occupancy(points, 0.8, made.starts, made.ends, made.radii)
    assert share.sum() == pytest.approx(label.occupancy.sum(), rel=0.15)
    assert (np.abs(points[share > 0.5].min(0) - low) < 2).all() and (high > low).all()


@pytest.mark.slow
def test_projection_of_capsules_is_that_of_the_mask(folder):
    label = read_label(folder / "a.nii.gz")
    made = capsules_of(label)
    carm = CArm(
        primary_angle_deg=30, secondary_angle_deg=20, sod_mm=750, sdd_mm=1100, rows=64,
        columns=64, pixel_spacing_mm=(2.2, 2.2),
    )  # fmt: skip
    mine = path_lengths(carm, made.starts, made.ends, made.radii)
    theirs = raycast(label, carm)
    a, b = mine > 0.8, theirs > 0.8
    assert 2 * (a & b).sum() / (a.sum() + b.sum()) > 0.9


def test_two_parts_are_two_sides():
    x, y, z = np.indices((60, 20, 30))
    both = np.zeros((60, 20, 30), np.float32)
    for middle in (6, 51):
        both[((x - middle) ** 2 + (y - 10) ** 2 <= 5) & (z > 1) & (z < 28)] = 1
    grid = Grid(center_mm=(0, 0, 0), size_mm=(60, 20, 30), shape=(60, 20, 30))
    tree = label_tree(LabelVolume(occupancy=both, grid=grid))
    assert len(tree.sides) == 2
    assert np.ptp(tree.whole.starts[:, 0]) > 40 > np.ptp(tree.sides[0].starts[:, 0])


def test_a_volume_without_a_vessel_is_named_by_its_file(tmp_path):
    volume = np.zeros((9, 9, 9), np.uint8)
    volume[4, 4, 4] = 1
    nibabel.save(nibabel.Nifti1Image(volume, np.diag([0.5, 0.5, 0.5, 1])), tmp_path / "dot.nii.gz")
    with pytest.raises(UsageError, match=r"^/.*/dot\.nii\.gz: no vessel is long enough"):
        read_label_trees(tmp_path)


def test_scenes_show_labels_about_as_often_as_asked(folder):
    trees, hashes = read_label_trees(folder)
    assert sorted(hashes) == ["a.nii.gz", "b.mha"] and len(trees) == 2
    always = SceneOptions(label_share=1.0)
    scene = training_scene(3, 0, always, trees)
    again = training_scene(3, 0, always, trees)
    np.testing.assert_array_equal(scene.occupancy, again.occupancy)
    # The labels' vessels are 1.8 and 2.2 mm in radius throughout, generated ones are not.
    radius = scene.radius_cells[scene.occupancy > 0.9] * scene.spacing_mm
    assert np.ptp(np.percentile(radius, [10, 90])) < 0.5
    config = train_paper.CONFIGS["tiny"]
    picture = training_pictures(3, 0, config, always, trees)[0]
    assert picture.known.any()


@pytest.mark.slow
@pytest.mark.parametrize("network", ["paper", "multi"])
def test_training_with_labels_remembers_them(tmp_path, folder, network):
    start(tmp_path / "run", network, "tiny", labels=folder)
    manifest = json.loads((tmp_path / "run/manifest.json").read_text())
    assert sorted(manifest["labels"]) == ["a.nii.gz", "b.mha"] and manifest["step"] == 4
    assert all(len(h) == 64 for h in manifest["labels"].values())
    with pytest.raises(UsageError, match=r"2 label volumes .* no labels"):
        start(tmp_path / "run", network, "tiny", steps=5)
    module = train_paper if network == "paper" else train_multi
    other = dict.fromkeys(manifest["labels"], "0" * 64)
    with pytest.raises(UsageError, match="give another --out, or the same labels"):
        module.train(
            tmp_path / "run", module.PRESETS["tiny"], module.CONFIGS["tiny"], label_hashes=other
        )
    with pytest.raises(UsageError, match="config"):
        module.train(
            tmp_path / "run",
            module.PRESETS["tiny"],
            dataclasses.replace(module.CONFIGS["cpu"]),
            label_hashes=manifest["labels"],
        )


def test_a_folder_without_labels_is_named(tmp_path):
    with pytest.raises(UsageError, match="no label volume in"):
        read_label_trees(tmp_path)


def test_gpu_preset_without_a_gpu_is_one_line(tmp_path):
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(UsageError, match="needs a CUDA device"):
        start(tmp_path / "run", "paper", "gpu")
    assert not (tmp_path / "run").exists()
