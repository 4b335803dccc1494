"""A volume of one's own against the truth: the same measures on any lattice, nothing cut off."""

import nibabel
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.errors import UsageError
from gcar_deploy.measure.metrics import volume_measures
from gcar_export.cli.main import main
from gcar_export.evaluate import own_volume

SPACING = 0.8


def save(path, array, corner=(0.0, 0.0, 0.0), spacing=SPACING):
    """Write an array whose voxel [0, 0, 0] lies at ``corner``, mm LPS."""
    affine = np.diag([-spacing, -spacing, spacing, 1.0])
    affine[:3, 3] = np.array([-1, -1, 1]) * corner
    nibabel.save(nibabel.Nifti1Image(array, affine), path)
    return path


@pytest.fixture(scope="module")
def tree():
    """(40, 40, 40) float32, a bent tube of shares."""
    volume = np.zeros((40, 40, 40), np.float32)
    for z in range(5, 35):
        x = int(20 + 8 * np.sin(z / 8))
        volume[x - 2 : x + 3, 18:23, z] = 0.4
        volume[x - 1 : x + 2, 19:22, z] = 1.0
    return volume


def test_the_measures_are_those_of_the_tables(tree, tmp_path):
    mine = np.roll(tree, 1, axis=0) * 0.9
    found = own_volume.compare(save(tmp_path / "m.nii.gz", mine), save(tmp_path / "t.nii", tree))
    names = [name for name in found.measures if name != "parts"]
    expected = volume_measures(tree, mine, (SPACING,) * 3, names)
    assert {n: found.measures[n].value for n in names} == pytest.approx(
        {n: one.value for n, one in expected.items()}
    )
    assert found.measures["parts"].value == 1 and not found.resampled
    assert 0.5 < found.measures["dsc"].value < 0.9


def test_what_lies_outside_of_the_truths_volume_counts(tree, tmp_path):
    """Another box of the same lattice, with a false branch where the truth has no voxels."""
    truth = save(tmp_path / "t.nii.gz", (tree[8:, :, 3:] >= 0.5).astype(np.uint8),
                 (8 * SPACING, 0, 3 * SPACING))  # fmt: skip
    mine = (tree >= 0.5).astype(np.uint8) * 255
    same = own_volume.compare(save(tmp_path / "m.nii.gz", mine), truth)
    assert same.measures["dsc"].value == 1.0 and not same.resampled
    mine[2, 2, 2:38] = 255
    more = own_volume.compare(save(tmp_path / "m.nii.gz", mine), truth)
    true = int((tree >= 0.5).sum())
    assert more.measures["dsc"].value == pytest.approx(2 * true / (2 * true + 36))
    assert more.measures["parts"].value == 2


def test_a_finer_lattice_is_brought_onto_the_truths(tree, tmp_path):
    mask = (tree >= 0.5).astype(np.uint8)
    fine = np.repeat(np.repeat(np.repeat(mask, 2, 0), 2, 1), 2, 2)
    mine = save(tmp_path / "m.nii.gz", fine, (-SPACING / 4,) * 3, SPACING / 2)
    found = own_volume.compare(mine, save(tmp_path / "t.nii.gz", mask))
    assert found.resampled and found.measures["dsc"].value > 0.95
    assert "resampled onto the truth" in own_volume.table(found)


def test_a_method_that_found_nothing_has_reasons_for_measures(tree, tmp_path):
    truth, mine = save(tmp_path / "t.nii.gz", tree), save(tmp_path / "m.nii.gz", 0 * tree)
    found = own_volume.compare(mine, truth).measures
    assert found["dsc"].value is None and "empty" in found["dsc"].reason
    assert found["parts"].value is None and "empty" in found["parts"].reason
    done = CliRunner().invoke(main, ["score", "--volume", str(mine), "--truth", str(truth)])
    assert done.exit_code == 0 and "| DSC(0.5) % | - (" in done.output, done.output
    with pytest.raises(UsageError, match="the label volume is empty"):
        own_volume.compare(truth, mine)


def test_two_frames_and_a_call_without_its_other_half_are_refused(tree, tmp_path):
    truth, mine = (save(tmp_path / "t.nii.gz", tree),
                   save(tmp_path / "m.nii.gz", tree, (100, 0, 0)))  # fmt: skip
    with pytest.raises(UsageError, match=r"m\.nii\.gz lies at 1\d\d .* must be in one frame"):
        own_volume.compare(mine, truth)
    for words in (["--volume", mine], ["--truth", truth], [],
                  [tmp_path, "--volume", mine, "--truth", truth]):  # fmt: skip
        done = CliRunner().invoke(main, ["score", *map(str, words)])
        assert done.exit_code == 2 and "or --volume with --truth" in done.output
    done = CliRunner().invoke(main, ["score", "--volume", str(truth), "--truth", str(truth)])
    assert done.exit_code == 0 and "| DSC(0.5) % | 100.00 |" in done.output, done.output
