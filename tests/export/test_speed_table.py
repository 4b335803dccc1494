"""Speed against error in one run: what is on the front, what is told, in which order."""

import json

import pytest

pytest.importorskip("numba")
pytest.importorskip("itk", reason="needs the export extra")

from gcar_deploy.measure.metrics import volume_dice
from gcar_export.cli.main import main
from gcar_export.methods.solve import solve
from gcar_export.scenes.labels import read_label
from gcar_export.scenes.protocols import make_case
from gcar_export.studies import speed_table as speed
from tests.export.label_files import write_tree


def _label(folder):
    path = folder / "one.nii.gz"
    write_tree(path, 1)
    return path


def row(name, pairs, dsc, stages=None):
    return speed.Row(
        setting=name, pairs=pairs, seconds=0.1 * pairs, cpu_seconds=0.2 * pairs, dsc=dsc,
        chamfer_mm=None, unsolved=0, front=False, stages=stages or {},
    )  # fmt: skip


def test_on_the_front_is_what_nothing_beats_in_both():
    made = [row("slow", 9, 0.8), row("good", 4, 0.9), row("bad", 5, 0.5), row("fast", 1, 0.5)]
    assert [r.setting for r in speed.front(made)] == ["fast", "good"]
    assert [r.setting for r in speed.front([row("b", 1, 0.5), row("a", 1, 0.6)])] == ["a"]


def test_gcar_stands_beside_the_peers():
    asked = speed.settings()
    lattices = {
        name: one.options.run_options(one.method).predict.lattices
        for name, one in asked.items()
        if one.method.startswith("multi")
    }
    assert lattices == {name: 1 if "1 lattice" in name else 2 for name in lattices}
    assert len(lattices) == 6 and speed.OURS in lattices
    assert {"fdk", "sart", "visual_hull", "nerp"} < {one.method for one in asked.values()}
    assert asked[f"NeRP, {speed.NERP_STEPS} steps"].options.nerp.steps == speed.NERP_STEPS


@pytest.mark.slow
def test_rounds_are_interleaved_and_errors_are_those_of_the_methods(tmp_path):
    case = make_case(read_label(_label(tmp_path)), "paper")
    asked = {"a": speed.Setting("visual_hull"), "b": speed.Setting("hull")}
    order = []

    def told(case, method, options):
        order.append(method)
        return solve(case, method, options)

    made = speed.rows([case], asked, 2, solver=told)
    assert order == ["visual_hull", "hull"] * 2
    a, b = made
    assert a.dsc == volume_dice(case.truth, solve(case, "visual_hull").volume).value
    assert a.pairs > 0 and b.pairs > 0 and not a.stages and "refine" in b.stages
    assert any(r.front for r in made) and json.loads(json.dumps(speed.values(made)))
    speed.picture(made).savefig(tmp_path / "p.png")
    assert (tmp_path / "p.png").stat().st_size > 5000


def test_an_unknown_protocol_and_a_picture_that_is_there(tmp_path, capsys):
    label = _label(tmp_path)
    for more, why in ((["--protocol", "new"], "--protocol new is none of paper"),
                      (["--picture", str(label)], f"{label} exists")):  # fmt: skip
        with pytest.raises(SystemExit) as end:
            main(["speed-table", str(label), *more])
        assert end.value.code == 2 and why in capsys.readouterr().err
