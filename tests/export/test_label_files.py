"""Which files of a folder are label volumes: the same for all verbs, and said what is left out."""

import nibabel
import numpy as np
import pytest
from click.testing import CliRunner

from gcar_deploy.errors import UsageError
from gcar_export.cli.main import main
from gcar_export.evaluate.evaluate import find_labels
from gcar_export.scenes.label_files import label_files
from gcar_export.scenes.label_trees import read_label_trees


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def names(folder, **options):
    return [str(p.relative_to(folder.resolve())) for p in label_files(folder, **options)]


@pytest.mark.parametrize(
    "name", ["a.nii", "a.nii.gz", "A.NII.GZ", "a.nrrd", "a.nhdr", "a.MHA", "a.mhd",
             "imagecas/7.label.nii.gz", "ImageCAS/7.nii", "asoca/Normal_1.nrrd", "data/a.mha",
             "data/asoca/a.nii.gz"],
)  # fmt: skip
def test_volumes_are_found_by_any_known_end(tmp_path, name):
    touch(tmp_path, name, "README.txt", "a.raw")
    assert names(tmp_path) == [name]
    assert find_labels(tmp_path) == label_files(tmp_path)


def test_what_is_left_out_is_named(tmp_path, capsys):
    touch(tmp_path, "imagecas/1.label.nii.gz", "imagecas/1.img.nii.gz", "imagecas/2.nii.gz",
          "asoca/n.npz", "b.mha", "patients/c.nii", "patients/d.nii", "notes/e.txt")  # fmt: skip
    found = ["imagecas/1.label.nii.gz", "imagecas/2.nii.gz", "b.mha"]
    assert names(tmp_path) == found
    said = capsys.readouterr().err
    assert (
        "3 label volumes; left out: imagecas/1.img.nii.gz, asoca/n.npz, patients/ (2 files)" in said
    )
    assert names(tmp_path, arrays=True) == [*found[:2], "asoca/n.npz", "b.mha"]
    assert "n.npz" not in capsys.readouterr().err


def test_a_folder_without_any_is_refused_with_what_lies_there(tmp_path):
    touch(tmp_path, "patients/c.nii", "n.npz")
    (tmp_path / "scan.dcm").touch()
    with pytest.raises(UsageError, match=r"no label volume in .*; left out: patients/ \(1 files\)"):
        label_files(tmp_path)
    for verb in (["tree-table"], ["lumen-table"], ["evaluate", "--out", str(tmp_path / "out")],
                 ["train", "--preset", "tiny", "--labels", str(tmp_path),
                  "--out", str(tmp_path / "run")]):  # fmt: skip
        data = [] if verb[0] == "train" else ["--data", str(tmp_path)]
        done = CliRunner().invoke(main, [*verb, *data])
        assert done.exit_code == 2 and "no label volume in" in done.output, (verb, done.output)
    assert not (tmp_path / "run").exists() and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_training_and_the_table_of_trees_read_what_the_evaluation_reads(tmp_path):
    volume = np.zeros((50, 50, 70), np.uint8)
    for z in range(8, 62):
        x, y = int(25 + 10 * np.sin(z / 12)), int(25 + 8 * np.cos(z / 15))
        volume[x - 2 : x + 3, y - 2 : y + 3, z] = 1
    (tmp_path / "imagecas").mkdir()
    file = tmp_path / "imagecas" / "1.NII.GZ"
    nibabel.save(nibabel.Nifti1Image(volume, np.diag([-0.7, -0.7, 0.7, 1])), tmp_path / "a.nii.gz")
    (tmp_path / "a.nii.gz").rename(file)
    trees, hashes = read_label_trees(tmp_path)
    assert len(trees) == 1 and list(hashes) == [file.name]
    done = CliRunner().invoke(main, ["tree-table", "--count", "1", "--data", str(tmp_path)])
    assert done.exit_code == 0 and "| real (1) |" in done.output, done.output
