"""The programs of the studies end with one line where a file is missing, not with a traceback."""

import pytest

from gcar_deploy.errors import ModelError
from gcar_export.studies import naming_fit, predictor_table, segmentation_table
from gcar_export.studies.command import ended


@pytest.mark.parametrize(("study", "words", "code", "said"), [
    (predictor_table, ["gone.onnx"], 5, "error: model file gone.onnx: no such file"),
    (segmentation_table, ["--data", "gone"], 2, "error: gone holds neither xca_masks/"),
    (naming_fit, ["--data", "gone", "--out", "n.json", "--trees", "0"], 2,
     "error: no such label volume: gone/imagecas/"),
])  # fmt: skip
def test_a_missing_file_is_one_line(tmp_path, monkeypatch, capsys, study, words, code, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["study", *words])
    assert ended(study.main) == code
    err = capsys.readouterr().err
    assert err.startswith(said) and err.count("\n") == 1


def test_what_cannot_be_written_is_one_line(capsys):
    def full():
        raise OSError(28, "No space left on device", "/a/b")

    assert ended(full) == 1
    assert capsys.readouterr().err == "error: /a/b: No space left on device\n"
    assert ended(lambda: None) == 0
    with pytest.raises(ZeroDivisionError):
        ended(lambda: 1 // 0)
    assert ModelError.exit_code == 5
