import gzip
import json

import numpy as np
import pytest
from scipy import ndimage

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.grid import Grid
from gcar_export.scenes.labels import LabelVolume, from_array, read_label
from tests.conftest import of_data

nibabel = pytest.importorskip("nibabel")


def two_trees():
    """Left tree 4x6x20 voxels, right tree 3x3x10, and a crumb; axes x, y, z in LPS."""
    array = np.zeros((40, 30, 30), np.uint8)
    array[28:32, 10:16, 5:25] = 1
    array[5:8, 4:7, 3:13] = 1
    array[2, 25, 25] = 1
    return array


RAS = np.diag([0.5, 0.5, 0.5, 1.0])
RAS[:3, 3] = (3.0, -2.0, 7.0)


def as_lps(world_ras):
    return np.asarray(world_ras) * (-1, -1, 1)


def test_axes_run_along_lps_whatever_the_file_says():
    array = np.zeros((4, 5, 6), np.uint8)
    array[1, 2, 4] = 1
    for permutation, signs in [((0, 1, 2), (1, 1, 1)), ((2, 0, 1), (-1, 1, -1))]:
        affine = np.eye(4)
        affine[:3, :3] = np.eye(3)[:, list(permutation)] * np.array(signs) * (0.5, 0.7, 0.9)
        affine[:3, 3] = (3, -2, 7)
        label = from_array(array, affine)
        at = label.grid.index2world(np.argwhere(label.occupancy))
        expected = as_lps(affine[:3, :3] @ (1, 2, 4) + affine[:3, 3])
        assert np.allclose(at, expected, atol=1e-9)
        assert np.allclose(label.affine[:3, :3] @ np.argwhere(label.occupancy)[0], at * (-1, -1, 1)
                           - label.affine[:3, 3])  # fmt: skip


def test_oblique_volume_keeps_place_and_mass():
    array = np.zeros((30, 30, 30))
    array[10:20, 12:18, 8:24] = 1
    c, s = np.cos(0.3), np.sin(0.3)
    affine = np.eye(4)
    affine[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) * 0.8
    affine[:3, 3] = (5, 6, 7)
    label = from_array(array, affine)
    assert label.volume_mm3 == pytest.approx(array.sum() * 0.8**3, rel=0.01)
    index = np.argwhere(label.occupancy > 0)
    weights = label.occupancy[tuple(index.T)]
    middle = np.average(label.grid.index2world(index), axis=0, weights=weights)
    expected = as_lps(affine[:3, :3] @ (14.5, 14.5, 15.5) + affine[:3, 3])
    assert np.allclose(middle, expected, atol=0.05)


def _nrrd(path, array, directions, origin, space, gz):
    head = (
        "NRRD0004\n# a comment\ntype: unsigned char\ndimension: 3\n"
        f"space: {space}\nsizes: {' '.join(map(str, array.shape))}\n"
        f"space directions: {' '.join(directions)}\nkinds: domain domain domain\n"
        f"endian: little\nencoding: {'gzip' if gz else 'raw'}\nspace origin: {origin}\n\n"
    )
    body = array.tobytes(order="F")
    path.write_bytes(head.encode() + (gzip.compress(body) if gz else body))


def _files(folder):
    array = two_trees()
    nibabel.save(nibabel.Nifti1Image(array, RAS), folder / "case.label.nii.gz")
    steps = ["(-0.5,0,0)", "(0,-0.5,0)", "(0,0,0.5)"]
    _nrrd(folder / "case.nrrd", array, steps, "(-3,2,7)", "left-posterior-superior", True)
    steps = ["(0.5,0,0)", "(0,0.5,0)", "(0,0,0.5)"]
    _nrrd(folder / "raw.nrrd", array, steps, "(3,-2,7)", "right-anterior-superior", False)
    head = (
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nCompressedData = False\n"
        "TransformMatrix = -1 0 0 0 -1 0 0 0 1\nOffset = -3 2 7\n"
        "ElementSpacing = 0.5 0.5 0.5\nDimSize = 40 30 30\nElementType = MET_UCHAR\n"
    )
    body = array.tobytes(order="F")
    (folder / "case.mha").write_bytes(f"{head}ElementDataFile = LOCAL\n".encode() + body)
    (folder / "case.mhd").write_text(f"{head}ElementDataFile = case.raw\n")
    (folder / "case.raw").write_bytes(body)
    return ["case.label.nii.gz", "case.nrrd", "raw.nrrd", "case.mha", "case.mhd"]


def test_all_formats_read_the_same(tmp_path):
    labels = [read_label(tmp_path / name) for name in _files(tmp_path)]
    for label in labels:
        assert label.volume_mm3 == pytest.approx(two_trees().sum() / 8)
        assert np.array_equal(label.occupancy, labels[0].occupancy)
        assert np.allclose(label.grid.lower_mm, labels[0].grid.lower_mm)


def test_shares_are_vessel_from_a_half_on_and_this_is_said(tmp_path, capsys):
    """A probability map, or the truth of a simulated case: above 0 it is far too wide."""
    shares = ndimage.gaussian_filter(two_trees().astype(np.float32), 1.0)
    assert (shares > 0).sum() > 2 * (shares >= 0.5).sum()
    nibabel.save(nibabel.Nifti1Image(shares, RAS), tmp_path / "map.nii.gz")
    label = read_label(tmp_path / "map.nii.gz")
    assert label.volume_mm3 == pytest.approx((shares >= 0.5).sum() / 8)
    assert (
        "map.nii.gz holds shares 0 .. 1: from 0.5 on a voxel is vessel" in capsys.readouterr().err
    )
    for name, factor in (("mask", 1.0), ("named", 3.0)):  # labels as numbers, in whatever type
        array = factor * two_trees().astype(np.float32)
        nibabel.save(nibabel.Nifti1Image(array, RAS), tmp_path / f"{name}.nii.gz")
        assert read_label(tmp_path / f"{name}.nii.gz").volume_mm3 == two_trees().sum() / 8
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "said"),
    [("box", "100% of its voxels are above 0"), ("ct", "grey values, as a CT does"),
     ("nan", "1 voxels are no finite numbers"), ("shear", "sheared, 71.6 deg apart")],
)  # fmt: skip
def test_what_is_no_label_of_vessels_is_refused_by_its_path(tmp_path, change, said):
    array, affine = two_trees().astype(np.float32), RAS.copy()
    if change == "box":
        array[:] = 1
    if change == "ct":  # an offset that makes air positive, and nothing beside the body
        array = np.random.default_rng(0).integers(1, 2000, array.shape).astype(np.int16)
        array[:8] = 0
    if change == "nan":
        array[0, 0, 0] = np.nan
    if change == "shear":
        affine[0, 1] = affine[1, 1] / 3
    nibabel.save(nibabel.Nifti1Image(array, affine), tmp_path / "a.nii.gz")
    with pytest.raises(UsageError, match=r"/a\.nii\.gz: .*" + said):
        read_label(tmp_path / "a.nii.gz")


def test_a_volume_of_other_axes_is_named_by_its_path(tmp_path):
    flat = np.ones((4, 4, 4, 2), np.uint8)
    nibabel.save(nibabel.Nifti1Image(flat, RAS), tmp_path / "4d2.nii.gz")
    with pytest.raises(UsageError, match=r"/4d2\.nii\.gz: a label volume has 3 axes, this has 4"):
        read_label(tmp_path / "4d2.nii.gz")


@pytest.mark.parametrize(
    ("name", "blob"),
    [
        ("a.nrrd", b"not a nrrd"),
        ("a.nrrd", b"NRRD0004\ntype: uchar\nsizes: 4 4 4\nencoding: raw\n\nshort"),
        ("a.nrrd", b"NRRD0004\ntype: uchar\nsizes: 2 2 2\nencoding: bzip2\n\n12345678"),
        ("a.nrrd", b"NRRD0004\ntype: uchar\nsizes: 4 4\nencoding: raw\n\n" + b"1" * 16),
        ("a.mha", b"DimSize = 4 4 4\n"),
        ("a.mhd", b"DimSize = 1 1 1\nElementType = MET_UCHAR\nElementDataFile = ../x\n"),
        ("a.txt", b"hello"),
        ("a.nrrd", b"NRRD0004\ntype: uchar\nsizes: 2 2 2\nencoding: raw\n\n" + bytes(8)),
    ],
)
def test_bad_files_are_one_line_errors(tmp_path, name, blob):
    (tmp_path / name).write_bytes(blob)
    with pytest.raises(UsageError) as caught:
        read_label(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_missing_file_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError):
        read_label(tmp_path / "nothing.nii.gz")


def test_left_tree_is_the_one_to_the_patients_left():
    grid = Grid(center_mm=(0, 0, 0), size_mm=(20, 15, 15), shape=(40, 30, 30))
    label = LabelVolume(occupancy=two_trees().astype(np.float32), grid=grid)
    left, right = label.left_right()
    assert left.occupancy.sum() == 4 * 6 * 20
    assert right.occupancy.sum() == 3 * 3 * 10
    low, high = left.centred().box_mm()
    assert np.allclose(low + high, 0)
    with pytest.raises(UsageError):
        left.left_right()
    crumb = left.occupancy.copy()
    crumb[-2:, -2:, -2:] = 1
    with pytest.raises(UsageError, match=r"1\.7% of the first one's volume: a crumb"):
        LabelVolume(occupancy=crumb, grid=left.grid).left_right()


def test_occupancy_on_a_grid_keeps_mass_and_the_identity():
    rng = np.random.default_rng(0)
    occupancy = np.zeros((30, 30, 30), np.float32)
    occupancy[8:22, 8:22, 8:22] = rng.random((14, 14, 14)) > 0.7
    grid = Grid(center_mm=(1, 2, 3), size_mm=(15, 15, 15), shape=(30, 30, 30))
    label = LabelVolume(occupancy=occupancy, grid=grid)
    assert np.array_equal(label.on_grid(grid), occupancy)
    coarse = Grid(center_mm=(1, 2, 3), size_mm=(18, 18, 18), shape=(12, 12, 12))
    out = label.on_grid(coarse)
    mass = out.sum(dtype=float) * np.prod(coarse.spacing_mm)
    assert mass == pytest.approx(label.volume_mm3, rel=2e-3)
    # a constant stays a constant
    full = LabelVolume(occupancy=np.ones_like(occupancy), grid=grid)
    inner = Grid(center_mm=(1, 2, 3), size_mm=(10, 10, 10), shape=(7, 7, 7))
    assert np.allclose(full.on_grid(inner), 1)


def test_cropping_keeps_every_voxel_in_place():
    label = LabelVolume(
        occupancy=two_trees().astype(np.float32),
        grid=Grid(center_mm=(0, 0, 0), size_mm=(20, 15, 15), shape=(40, 30, 30)),
    )
    left = label.left_right()[0]
    small = left.cropped()
    assert small.occupancy.shape == (8, 10, 24)
    assert np.allclose(small.box_mm(), left.box_mm())
    assert small.volume_mm3 == left.volume_mm3


@pytest.mark.parametrize(
    "case", ["0001", *(pytest.param(c, marks=pytest.mark.slow) for c in ("0401", "0595"))]
)
@pytest.mark.parametrize("protocol", ["P", "C"])
def test_truth_of_the_ready_cases(case, protocol):
    label = read_label(of_data("imagecas", f"{case}.label.nii.gz"))
    folder = of_data("cases", f"{protocol}_{case}")
    volume = json.loads((folder / "geom.json").read_text())["volume"]
    grid = Grid(**{key: tuple(value) for key, value in volume.items()})
    tree = label if protocol == "P" else label.left_right()[0].centred()
    truth = np.asarray(nibabel.load(folder / "truth.nii.gz").dataobj)
    assert np.abs(tree.on_grid(grid) - truth).max() < 1e-6


def test_asoca_case():
    label = read_label(of_data("asoca", "normal_1.npz"))
    assert label.occupancy.max() <= 1
    left, right = label.left_right()
    # The left tree lies to the left of, behind and above the right one.
    centre = [np.mean(t.box_mm(), axis=0) for t in (left, right)]
    assert (centre[0] > centre[1]).all()
    # Both begin above their middle, the left one to the right of and behind its own. The other
    # way round, the places of the trees would be these as well, and their beginnings not.
    begins = []
    for tree in (left, right):
        thick = ndimage.distance_transform_edt(tree.occupancy >= 0.5)
        index = np.argwhere(thick >= np.quantile(thick[thick > 0], 0.98)).astype(float)
        middle = np.argwhere(tree.occupancy >= 0.5).astype(float)
        begins.append(tree.grid.index2world(index).mean(0) - tree.grid.index2world(middle).mean(0))
    assert begins[0][0] < 0 < begins[0][1] and begins[0][2] > 0 and begins[1][2] > 0


@pytest.mark.parametrize(("unit", "mm"), [("meter", 1000.0), ("micron", 0.001), ("mm", 1.0)])
def test_the_unit_of_a_header_counts(tmp_path, unit, mm):
    volume = np.zeros((20, 20, 20), np.uint8)
    volume[5:15, 9:11, 9:11] = 1
    image = nibabel.Nifti1Image(volume, np.diag([-0.5 / mm, -0.5 / mm, 0.5 / mm, 1]))
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / "a.nii.gz")
    label = read_label(tmp_path / "a.nii.gz")
    assert label.grid.spacing_mm == pytest.approx([0.5] * 3)
    assert label.volume_mm3 == pytest.approx(40 * 0.125)


def test_an_empty_file_is_said_to_be_one(tmp_path):
    (tmp_path / "a.nii.gz").touch()
    with pytest.raises(UsageError, match=r"a\.nii\.gz: the file is empty$"):
        read_label(tmp_path / "a.nii.gz")
