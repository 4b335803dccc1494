import csv
import json
import shutil
import types
from pathlib import Path

import cv2
import nibabel
import numpy as np
import pytest
from scipy import ndimage

from gcar_deploy.errors import ModelError, RefusedError, UsageError
from gcar_export.evaluate import engines as evaluation_engines
from gcar_export.evaluate import evaluate, paper_tables, score
from gcar_export.evaluate import jobs as evaluation_jobs
from gcar_export.evaluate import tables as evaluation_tables
from gcar_export.methods import solve as methods
from gcar_export.methods.settings import DESCRIPTIONS, METHODS, MethodSettings
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import PROTOCOLS, make_case, write_case
from tests.conftest import data_dir


def shared(*parts):
    for base in (data_dir(), data_dir() / "data"):
        if base.joinpath(*parts).exists():
            return base.joinpath(*parts)
    pytest.skip("GCAR_DATA has no " + "/".join(parts))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two small generated label volumes, each with a left and a right tree."""
    folder = tmp_path_factory.mktemp("data") / "imagecas"
    folder.mkdir()
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        volume = np.zeros((120, 100, 100), np.uint8)
        for x in (25, 90):
            t = np.linspace(0, 1, 400)
            line = np.column_stack(
                [x + 10 * np.sin(3 * t + rng.uniform(0, 3)), 20 + 60 * t, 15 + 70 * t**2]
            )
            for dx in range(-2, 3):
                for dy in range(-2, 3):
                    for dz in range(-2, 3):
                        if dx * dx + dy * dy + dz * dz <= 5:
                            at = np.rint(line + np.array([dx, dy, dz])).astype(int)
                            volume[tuple(at.T)] = 1
        affine = np.diag([-0.5, -0.5, 0.5, 1.0])
        affine[:3, 3] = (30, 25, -25)
        nibabel.save(nibabel.Nifti1Image(volume, affine), folder / f"{seed}.label.nii.gz")
    return folder.parent


class PerfectEngine:
    """Stands in for the runtime: returns what a table asks for."""

    answers: dict = {}  # noqa: RUF012
    model = {"name": "stub"}  # noqa: RUF012

    def __init__(self, *, model=None, options=None, segmenter_model=None):
        self.options = options

    def warmup(self):
        return 0.0

    def reconstruct(self, angiograms, grid):
        return types.SimpleNamespace(
            volume=self.answers["volume"](len(angiograms)),
            seconds={"refine": 0.25},
            counts={"gaussians": 7},
            quality=types.SimpleNamespace(status="ok", sentence="fine"),
        )


@pytest.mark.slow
def test_cases_are_consistent(data):
    label = read_label(data / "imagecas" / "1.label.nii.gz")
    for protocol in PROTOCOLS:
        case = make_case(label, protocol)
        assert len(case.pictures) == len(case.scene.views) == 2
        assert case.truth.shape == case.grid.shape
        for view, picture in zip(case.scene.views, case.pictures, strict=True):
            assert picture.shape == (view.carm.rows, view.carm.columns)
        mass = case.truth.sum() * np.prod(case.grid.spacing_mm)
        assert mass == pytest.approx(case.label.volume_mm3, rel=0.01)
    with pytest.raises(UsageError):
        make_case(label, "papers")
    with pytest.raises(UsageError):
        make_case(label, "paper", views=1)


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "pitch", "side"), [
    ("common-lca", 0.65, 0), ("common-rca", 0.55, 1),
])  # fmt: skip
def test_the_common_protocol_shows_masks_of_one_artery_at_its_centroid(data, protocol, pitch, side):
    label = read_label(data / "imagecas" / "1.label.nii.gz")
    case = make_case(label, protocol)
    assert case.grid.spacing_mm == pytest.approx(0.5)
    filled = case.grid.index2world(np.argwhere(case.truth >= 0.5))
    assert np.abs(filled.mean(axis=0)).max() < 0.25  # voxels of 0.5 mm
    assert len(filled) == pytest.approx((label.left_right()[side].occupancy > 0).sum(), rel=0.05)
    for view, picture in zip(case.scene.views, case.pictures, strict=True):
        assert view.intensity.kind == "mask" and set(np.unique(picture)) == {0, 255}
        assert view.carm.pixel_spacing_mm == (pitch, pitch)
        assert (view.carm.sod_mm, view.carm.sdd_mm, view.carm.rows) == (750, 900, 256)
        # the silhouette of the voxels, no more than half a pixel wider
        pixels = np.rint(view.carm.project(filled)[0]).astype(int)
        assert (picture[pixels[:, 1], pixels[:, 0]] > 0).mean() > 0.97
        near = np.zeros(picture.shape, bool)
        near[pixels[:, 1], pixels[:, 0]] = True
        assert not ((picture > 0) & (ndimage.binary_dilation(near, iterations=2) == 0)).any()
    with pytest.raises(UsageError, match="two views"):
        make_case(label, protocol, views=4)


@pytest.mark.slow
def test_the_common_protocol_is_measured_as_its_peers_are(data, tmp_path, monkeypatch):
    label = data / "imagecas" / "1.label.nii.gz"
    truth = make_case(read_label(label), "common-rca").truth.copy()
    truth[5:8, 5:8, 5:8] = 1.0  # a second component, far from the artery
    PerfectEngine.answers = {"volume": lambda views: truth}
    monkeypatch.setattr("gcar_deploy.engine.Engine", PerfectEngine)
    methods._session.cache_clear()
    options = evaluate.EvaluateOptions(
        data=data, out=tmp_path, protocol="common", methods=("ours",), cases=("1",),
        settings=MethodSettings(),
    )  # fmt: skip
    assert options.protocols == ("common-lca", "common-rca")
    rows = {row["protocol"]: row["measures"] for row in evaluate.evaluate(options)}
    methods._session.cache_clear()
    right = rows["common-rca"]
    assert right["parts"] == 2 and right["dsc"] > 0.99
    assert right["cd_mm"] == pytest.approx(2 * right["chamfer_mm"]) and right["cd_mm"] > 0.1
    assert rows["common-lca"]["dsc"] < 0.4
    text = (tmp_path / "tables.md").read_text()
    for words in ("### common-lca", "### common-rca", "other cases of the same set", "DeepCA"):
        assert words in text
    assert "new-proj." not in text and "SSIM" not in text


@pytest.mark.parametrize("views", [2, 4, 8, 16])
def test_paper_views_share_half_a_turn_and_new_ones_lie_between(data, views):
    case = make_case(read_label(data / "imagecas" / "1.label.nii.gz"), "paper", views)
    angles = [v.carm.primary_angle_deg for v in case.scene.views]
    assert np.allclose(np.diff(angles), 180 / views)
    new = [c.primary_angle_deg for c in case.new_views]
    assert np.allclose(np.array(new) - angles, 90 / views)


def test_case_folder_round_trip(data, tmp_path):
    from gcar_deploy.geometry.scene import load_scene

    case = make_case(read_label(data / "imagecas" / "1.label.nii.gz"), "clinical")
    written = write_case(case, tmp_path)
    assert sorted(written) == sorted(tmp_path.iterdir())
    scene = load_scene(tmp_path / "geom.json")
    assert [v.carm for v in scene.views] == case.scene_carms
    truth = nibabel.load(tmp_path / "truth.nii.gz")
    assert np.allclose(truth.affine, case.grid.affine_ras())


@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["P", "C", "M"])
def test_protocols_make_the_ready_cases(prefix):
    from gcar_deploy.geometry.scene import load_scene

    folder = shared("cases", f"{prefix}_0595")
    protocol = {"P": "paper", "C": "clinical", "M": "moved"}[prefix]
    case = make_case(read_label(shared("imagecas", "0595.label.nii.gz")), protocol)
    scene = load_scene(folder / "geom.json")
    assert scene.grid == case.grid
    assert [v.carm for v in scene.views] == case.scene_carms
    for index, picture in enumerate(case.pictures):
        ready = cv2.imread(str(folder / f"view{index + 1}.png"), cv2.IMREAD_UNCHANGED)
        assert np.abs(picture.astype(int) - ready).max() <= 1
    truth = np.asarray(nibabel.load(folder / "truth.nii.gz").dataobj)
    assert np.abs(case.truth - truth).max() < 1e-6


def test_truth_scores_perfectly_and_a_missing_volume_is_undefined(data):
    case = make_case(read_label(data / "imagecas" / "1.label.nii.gz"), "paper")
    ok = methods.Solved(volume=case.truth, seconds={}, gaussians=None, status="ok", sentence="")
    found = evaluation_jobs.measure(case, ok)
    # what only the moved, the common and the thin protocol ask for
    elsewhere = {"shifted_dsc", "cd_mm", "parts", "found_1mm", "true_1mm"}
    assert set(evaluation_tables.MEASURES) - elsewhere == set(found) - {"best_threshold"}
    assert found["dsc"].value == 1.0
    assert found["new_dsc"].value > 0.8
    none = methods.Solved(volume=None, seconds={}, gaussians=None, status="failed", sentence="")
    assert all(m.value is None and m.reason for m in evaluation_jobs.measure(case, none).values())


@pytest.fixture
def engine(monkeypatch, data):
    module = types.ModuleType("gcar_deploy.engine")
    module.Engine = PerfectEngine
    monkeypatch.setitem(__import__("sys").modules, "gcar_deploy.engine", module)
    methods._session.cache_clear()
    truth = make_case(read_label(data / "imagecas" / "1.label.nii.gz"), "paper").truth
    monkeypatch.setattr(PerfectEngine, "answers", {"volume": lambda views: truth * 0.9})
    yield PerfectEngine
    methods._session.cache_clear()


@pytest.mark.slow
def test_evaluation_writes_tables_and_resumes(data, tmp_path, engine, monkeypatch):
    options = evaluate.EvaluateOptions(
        data=data, out=tmp_path, protocol="paper", methods=("ours", "visual_hull"), views=(2, 4)
    )
    calls = []
    rows = evaluate.evaluate(options, lambda *a: calls.append(a))
    assert len(rows) == len(calls) == 8
    assert calls[-1][:2] == (8, 8)
    table = list(csv.DictReader((tmp_path / "cases.csv").open()))
    assert len(table) == 8
    assert {r["gaussians"] for r in table if r["method"] == "ours"} == {"7"}
    assert all(r["seconds_refine"] == "0.25" for r in table if r["method"] == "ours")
    for name in ("summary.json", "wilcoxon.json"):
        json.loads((tmp_path / name).read_text(), parse_constant=pytest.fail)
    assert "| ours |" in (tmp_path / "tables.md").read_text()
    assert not list(tmp_path.glob("rows/*.tmp"))
    # interrupted: one row is gone, only that one is made again
    (tmp_path / "rows" / "paper-2-4-ours.json").unlink()
    counted = _counting(evaluation_engines.run_job, calls := [])
    monkeypatch.setattr(evaluation_engines, "run_job", counted)
    again = evaluate.evaluate(options)
    assert len(calls) == 1
    assert [r["measures"] for r in again] == [r["measures"] for r in rows]


def _counting(function, calls):
    def counted(job, settings):
        calls.append(job)
        return function(job, settings)

    return counted


@pytest.mark.slow
def test_changed_settings_are_redone_kept_or_refused_aloud(data, tmp_path, engine, caplog):
    given = {"data": data, "out": tmp_path, "protocol": "paper", "methods": ("visual_hull",)}
    first = evaluate.evaluate(evaluate.EvaluateOptions(**given))
    wider = MethodSettings(hull_path_mm=8.0)
    changed = {**given, "settings": wider}
    with pytest.raises(UsageError, match=r"2 rows of visual_hull .* other settings"):
        evaluate.evaluate(evaluate.EvaluateOptions(**changed, changed="refuse"))
    kept = evaluate.evaluate(evaluate.EvaluateOptions(**changed, changed="keep"))
    assert [r["measures"] for r in kept] == [r["measures"] for r in first]
    assert "kept as they are" in caplog.text
    calls = []
    redone = evaluate.evaluate(evaluate.EvaluateOptions(**changed), lambda *a: calls.append(a))
    assert "made again" in caplog.text
    assert len(calls) == 2
    assert {r["settings"] for r in redone} == {wider.digest("visual_hull")}
    assert redone[0]["measures"] != first[0]["measures"]
    # nothing changed: nothing is made, unless it is asked for
    calls.clear()
    evaluate.evaluate(evaluate.EvaluateOptions(**changed), lambda *a: calls.append(a))
    assert [text for *_, text in calls] == ["2 rows kept"]
    again = evaluate.EvaluateOptions(**changed, redo=("visual_hull",))
    calls.clear()
    evaluate.evaluate(again, lambda *a: calls.append(a))
    assert len(calls) == 2


@pytest.mark.slow
@pytest.mark.parametrize("before", ["another file", "no hash"])
def test_rows_are_tied_to_their_label_file(data, tmp_path, monkeypatch, caplog, before):
    label = tmp_path / "data" / "1.nii.gz"
    label.parent.mkdir()
    shutil.copy(data / "imagecas" / "1.label.nii.gz", label)
    given = {"data": label.parent, "out": tmp_path / "out", "protocol": "paper",
             "methods": ("visual_hull",)}  # fmt: skip
    first = evaluate.evaluate(evaluate.EvaluateOptions(**given))
    truth = (tmp_path / "out" / "sides" / "paper-1-0-truth.png").read_bytes()
    if before == "no hash":
        (file,) = (tmp_path / "out" / "rows").iterdir()
        file.write_text(json.dumps({k: v for k, v in first[0].items() if k != "label_sha256"}))
    else:
        shutil.copy(data / "imagecas" / "2.label.nii.gz", label)
    with pytest.raises(UsageError, match=r"1 rows of visual_hull .* made with other label files:"):
        evaluate.evaluate(evaluate.EvaluateOptions(**given, changed="refuse"))
    kept = evaluate.evaluate(evaluate.EvaluateOptions(**given, changed="keep"))
    assert kept[0]["measures"] == first[0]["measures"] and "kept as they are" in caplog.text
    (redone,) = evaluate.evaluate(evaluate.EvaluateOptions(**given))
    other = before == "another file"
    assert (redone["measures"] != first[0]["measures"]) == other
    after = (tmp_path / "out" / "sides" / "paper-1-0-truth.png").read_bytes()
    assert (after != truth) == other
    caplog.clear()
    evaluate.evaluate(evaluate.EvaluateOptions(**given, changed="refuse"))


@pytest.mark.slow
def test_a_label_that_no_case_can_be_made_of_is_a_row_with_its_reason(data, tmp_path):
    from click.testing import CliRunner

    from gcar_export.cli.main import main

    labels = tmp_path / "data"
    labels.mkdir()
    good = nibabel.load(data / "imagecas" / "1.label.nii.gz")
    one = np.asarray(good.dataobj).copy()
    one[:60] = 0
    for name, array in (("0-empty", 0 * one), ("1-single", one)):
        nibabel.save(nibabel.Nifti1Image(array, good.affine), labels / f"{name}.nii.gz")
    given = ["evaluate", "--data", labels, "--protocol", "clinical", "--methods", "visual_hull"]
    given += ["--quiet", "--out", tmp_path / "out"]

    def command(*more):
        done = CliRunner().invoke(main, [str(word) for word in (*given, *more)])
        return done.exit_code, done.stderr.splitlines()

    code, (line,) = command()
    assert code == 2 and not (tmp_path / "out").exists()
    assert line.startswith("gcar-export: error: no case can be made: ")
    assert line.endswith("0-empty.nii.gz: the label volume is empty")
    nibabel.save(good, labels / "2.nii.gz")
    code, lines = command()
    assert code == 0 and lines[0] == "2 of 3 cases could not be made:"
    assert lines[1].endswith("0-empty.nii.gz: the label volume is empty")
    assert lines[2] == "  1-single: one connected part only, no left and right tree"
    rows = evaluation_tables.read_case_rows(tmp_path / "out" / "cases.csv")
    assert [(row["case"], row["status"]) for row in rows] == [
        ("0-empty", "no case"), ("1-single", "no case"), ("2", "ok"),
    ]  # fmt: skip
    assert rows[1]["sentence"] == lines[2].strip() and rows[1]["seconds"] is None
    assert "(n=1)" in (tmp_path / "out" / "tables.md").read_text()
    assert (tmp_path / "out" / "report.html").is_file()
    # kept like any other row; alone it is an error again
    assert command("--changed", "refuse") == (code, lines)
    code, (line,) = command("--cases", "1-single")
    assert code == 2 and line.endswith("no left and right tree")


def test_rows_depend_on_their_own_settings_alone():
    plain, other = MethodSettings(), MethodSettings(paper_steps=7)
    same = {m for m in METHODS if plain.digest(m) == other.digest(m)}
    assert {"fdk", "sart", "nerp", "visual_hull"} <= same
    assert not {"hull+paper", "3dgr-fbp", "multi+paper"} & same
    assert plain.digest("3dgr-gcp") != plain.digest("3dgr-gcp-l2")
    assert plain.digest("ours") != plain.digest("ours-swapped")
    assert other.run_options("hull+paper").refine.paper.steps == 7
    assert plain.run_options("3dgr-gcp-l2").refine.paper.alpha == 1.0
    assert not plain.run_options("ours-nopose").pose.enabled
    assert not plain.run_options("ours-round").refine.fuse
    assert plain.run_options("ours-classic").imaging.segmenter == "classic"
    assert plain.run_options("multi+tube") != plain.run_options("ours-round")
    assert set(DESCRIPTIONS) == set(METHODS)
    with pytest.raises(UsageError):
        MethodSettings(paper_steps=0)


def test_a_missing_model_is_said_before_any_work(data, tmp_path, monkeypatch):
    monkeypatch.setattr("gcar_deploy.models.spec.shipped_model_path", lambda name: None)
    methods._session.cache_clear()
    options = evaluate.EvaluateOptions(
        data=data, out=tmp_path / "out", protocol="paper", methods=("fdk", "3dgr-gcp")
    )
    with pytest.raises(ModelError, match=r"^method 3dgr-gcp: predictor paper has no model"):
        evaluate.evaluate(options)
    assert not (tmp_path / "out").exists()


def test_refusals_are_rows(data, tmp_path, engine, monkeypatch):
    def refuse(views):
        raise RefusedError("no vessel found in view 2")

    monkeypatch.setattr(engine, "answers", {"volume": refuse})
    options = evaluate.EvaluateOptions(
        data=data, out=tmp_path, protocol="paper", methods=("ours",), cases=("1",)
    )
    (row,) = evaluate.evaluate(options)
    assert row["status"] == "refused"
    assert row["measures"]["dsc"] is None
    assert row["reasons"]["dsc"] == "no prediction"
    assert "(n=0)" not in evaluation_tables.markdown([row])


@pytest.mark.parametrize(
    "wrong",
    [{"protocol": "x"}, {"methods": ("x",)}, {"methods": ()}, {"views": (1,)}, {"jobs": 0},
     {"reference": "hull"}, {"engine": "x"}, {"changed": "x"}, {"redo": ("hull",)},
     {"methods": ("ours", "ours")}, {"views": (2, 2)}, {"cases": ("1", "1")}],
)  # fmt: skip
def test_wrong_options_are_usage_errors(tmp_path, wrong):
    good = {"data": tmp_path, "out": tmp_path, "protocol": "paper", "methods": ("ours",)}
    with pytest.raises(UsageError):
        evaluate.EvaluateOptions(**{**good, **wrong})


def test_empty_data_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError):
        evaluate.find_labels(tmp_path)


def test_a_case_is_named_by_all_of_its_file_name_but_the_suffix(tmp_path):
    for name in ("patient.1.nii.gz", "patient.2.nii.gz", "1.2.840.label.nii.gz"):
        (tmp_path / name).touch()
    found = evaluate.find_labels(tmp_path)
    names = [evaluation_jobs.case_name(path) for path in found]
    assert names == ["1.2.840", "patient.1", "patient.2"]
    assert evaluate.find_labels(tmp_path, ("patient.2",)) == [found[2]]
    with pytest.raises(UsageError, match=r"cases: patient, 9 is not in /"):
        evaluate.find_labels(tmp_path, ("patient", "patient.1", "9"))
    (tmp_path / "imagecas").mkdir()
    (tmp_path / "imagecas" / "patient.1.label.nii.gz").touch()
    assert len(evaluate.find_labels(tmp_path, ("patient.2",))) == 1
    with pytest.raises(UsageError, match=r"\.label\.nii\.gz and /.* are both case patient\.1"):
        evaluate.find_labels(tmp_path)


def _row(case, method, dsc):
    measures = dict.fromkeys(evaluation_tables.MEASURES) | {"dsc": dsc}
    return {
        "protocol": "paper", "dataset": "ImageCAS", "views": 2, "case": case, "method": method,
        "status": "ok", "sentence": "", "models": "", "measures": measures,
        "gaussians": None, "seconds": 1.0, "cpu_seconds": 2.0,
        "stages": {}, "reasons": {},
    }  # fmt: skip


def test_wilcoxon_of_nine_better_cases():
    rows = [_row(str(k), "a", 0.5 + 0.01 * k) for k in range(9)]
    rows += [_row(str(k), "b", 0.4 + 0.002 * k) for k in range(9)]
    (test,) = [t for t in evaluation_tables.paired_tests(rows, "a") if t["measure"] == "dsc"]
    assert test["p"] == pytest.approx(2 / 2**9)
    assert (test["n"], test["stars"]) == (9, "**")
    assert "40.80 ± 0.55**" in evaluation_tables.markdown(rows, "a")


def test_case_rows_survive_the_csv(tmp_path):
    row = _row("1", "a", 0.5)
    row |= {"sentence": "so, and so", "gaussians": 7.0, "stages": {"refine": 0.25}}
    row["measures"]["best_threshold"] = 0.3
    row["reasons"] = {"ssim": "too small", "ot_1mm": "prediction is empty"}
    path = tmp_path / "cases.csv"
    path.write_text(evaluation_tables.case_rows_csv([row]))
    assert evaluation_tables.read_case_rows(path) == [row]
    path.write_text("a,b\n1,2\n")
    with pytest.raises(UsageError):
        evaluation_tables.read_case_rows(path)
    with pytest.raises(UsageError):
        evaluation_tables.read_case_rows(tmp_path / "none.csv")


def test_the_text_says_where_the_reference_is_not_first():
    rows = [_row(str(k), "ours", 0.5 + 0.01 * k) for k in range(9)]
    rows += [_row(str(k), "hull", 0.4 + 0.002 * k) for k in range(9)]
    assert evaluation_tables.not_first(rows, "ours") == []
    rows += [_row(str(k), "sart", 0.6) for k in range(9)]
    rows += [_row(str(k), "fdk", 0.5 + 0.01 * k + (-1) ** k * 0.1 - 0.02) for k in range(9)]
    (said,) = evaluation_tables.not_first(rows, "ours")
    assert said.startswith("paper, 2 views, DSC(0.5) %: sart leads by 6.00 (p = 0.004, n=9)")
    assert "not significantly ahead of fdk (by 0.89, p = " in said
    rows += [{**row, "method": "ours-nopose"} for row in rows if row["method"] == "ours"]
    (said,) = evaluation_tables.not_first(rows, "ours")
    assert said.endswith("; equal in every case: ours-nopose (n=9)")


def test_paper_layout_keeps_datasets_apart_and_marks_printed_figures():
    rows = [_row("1", "ours", 0.8), _row("1", "fdk", 0.3), _row("1", "nerp", 0.4)]
    rows += [{**_row("2", m, 0.5), "dataset": "ASOCA"} for m in ("ours", "fdk")]
    text = paper_tables.layout(rows, "ours")
    assert "| ImageCAS (1) | gcar as it comes | - | - | 80.00 | - |" in text
    assert "| ASOCA (1) | FBP (FDK) | - | - | 50.00 | - |" in text
    printed = [line for line in text.splitlines() if paper_tables.NOTE in line]
    assert len(printed) == 3  # FBP and NeRP of ImageCAS, FBP of ASOCA: what we have rows of
    assert "31.36 ± 3.33" in printed[0]
    assert paper_tables.layout([{**row, "protocol": "raw"} for row in rows], "ours") == ""


def test_views_stand_side_by_side():
    rows = [_row("1", "ours", 0.8), {**_row("1", "ours", 0.9), "views": 4}]
    assert "| ours | 80.00 | 90.00 |" in evaluation_tables.over_views(rows)
    assert evaluation_tables.over_views(rows[:1]) == ""
    assert evaluation_tables.worse_with_views(rows, "ours") == []
    rows.append({**_row("1", "ours", 0.88), "views": 16})
    assert evaluation_tables.worse_with_views(rows[::-1], "ours") == [
        "paper, DSC(0.5) %: ours loses 2.00 from 4 to 16 views"
    ]


def test_undefined_values_are_left_out_and_counted():
    rows = [_row("1", "a", 0.5), _row("2", "a", None), _row("1", "b", 0.5)]
    summary = evaluation_tables.summarise(rows)[0]["dsc"]
    assert summary == {"mean": 0.5, "sd": None, "n": 1}
    assert "50.00 (n=1)" in evaluation_tables.markdown(rows)
    # A method that was run on fewer cases than the others says so as well.
    assert "| b | 50.00 (n=1) |" in evaluation_tables.markdown(rows)
    tests = evaluation_tables.paired_tests(rows, "a")
    assert {t["reason"] for t in tests} == {
        "all differences are zero", "no case on which both are defined",
    }  # fmt: skip


def test_a_common_shift_is_asked_of_moved_patients_alone(data):
    case = make_case(read_label(data / "imagecas" / "1.label.nii.gz"), "moved")
    ok = methods.Solved(
        volume=np.roll(case.truth, (2, -1, 3), (0, 1, 2)), seconds={}, gaussians=None,
        status="ok", sentence="",
    )  # fmt: skip
    found = evaluation_jobs.measure(case, ok)
    assert found["shifted_dsc"].value == 1.0 and found["dsc"].value < 0.7
    rows = [_row("0", "a", 0.5)]
    assert "common shift" not in evaluation_tables.markdown(rows)
    rows[0]["measures"]["shifted_dsc"] = 0.6
    assert "common shift" in evaluation_tables.markdown(rows)


def test_score_refuses_a_folder_that_is_no_case(tmp_path):
    with pytest.raises(UsageError):
        score.score_case(tmp_path)


def _ready(folder, truth):
    folder.mkdir()
    (folder / "view1.png").touch()
    nibabel.save(nibabel.Nifti1Image(truth, np.eye(4)), folder / "truth.nii.gz")
    return folder


def test_score_goes_on_after_a_case_that_is_none(tmp_path, monkeypatch):
    from click.testing import CliRunner

    from gcar_export.cli.main import main

    none = types.SimpleNamespace(returncode=6, stderr="gcar: no vessel")
    monkeypatch.setattr(score.subprocess, "run", lambda *_, **__: none)
    cube = np.zeros((3, 3, 3), np.float32)
    cube[1, 1, 1] = 1
    cases = [_ready(tmp_path / "shares", 255 * cube), _ready(tmp_path / "nan", cube * np.nan),
             _ready(tmp_path / "good", cube), tmp_path / "empty"]  # fmt: skip
    cases[-1].mkdir()
    done = CliRunner().invoke(main, ["score", *map(str, cases)])
    assert done.exit_code == 2 and "| good | 6 | gcar: no vessel |" in done.stdout
    last = done.stderr.splitlines()[-1]
    assert last.startswith("gcar-export: error: 3 of 4 cases were not scored: ")
    assert "shares/truth.nii.gz: values 0 .. 255 are not 0 .. 1 (share of vessel)" in last
    assert "nan/truth.nii.gz: values nan" in last and "empty: not a ready case" in last


def test_score_reads_what_the_command_wrote(data, tmp_path, monkeypatch):
    case = make_case(read_label(data / "imagecas" / "1.label.nii.gz"), "clinical")
    folder = tmp_path / "M_1"
    write_case(case, folder)

    def command(words, **_):
        out = Path(words[words.index("--out") + 1])
        out.mkdir()
        shifted = np.roll(case.truth, (2, -1, 3), (0, 1, 2))
        image = nibabel.Nifti1Image(shifted, case.grid.affine_ras())
        nibabel.save(image, out / "volume.nii.gz")
        (out / "result.json").write_text('{"status": "ok"}')
        return types.SimpleNamespace(returncode=0, stderr="")

    monkeypatch.setattr(score.subprocess, "run", command)
    found = score.score_case(folder)
    # What is measured does not hang on the folder's name.
    assert found.shifted_dsc.value == 1.0
    assert found.dsc.value < found.best_dsc.value + 1e-9 < 1.0
    other = score.score_case(folder.rename(tmp_path / "P_1"))
    assert (other.dsc, other.shifted_dsc) == (found.dsc, found.shifted_dsc)
    text = score.table([found, other])
    assert "| case | exit | status | DSC % | DSC, common shift allowed % | best DSC % |" in text
    assert f"| M_1 | 0 | ok | {100 * found.dsc.value:.2f} | 100.00 |" in text
    assert f"| mean of P_* (1 cases) | | | {100 * found.dsc.value:.2f} | 100.00 |" in text


def test_command_line_lists_its_verbs():
    from click.testing import CliRunner

    from gcar_export.cli.main import main

    shown = CliRunner().invoke(main, ["--help"]).output
    for verb in ("evaluate", "converge", "score", "simulate", "pair-time"):
        assert verb in shown
        assert "Example:" in CliRunner().invoke(main, [verb, "--help"]).output
