"""Real pictures that a network has not seen: folds, one by one and beside each other."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from safetensors.torch import load_file  # noqa: E402

from gcar_deploy.errors import ImageError, UsageError  # noqa: E402
from gcar_export.scenes.expert_pictures import expert_mask, expert_pictures, folds  # noqa: E402
from gcar_export.training.segmenter import (  # noqa: E402
    TINY,
    chosen,
    left_out_by,
    real_pictures,
    train,
)
from tests.export.drawn_angiograms import write_drawn  # noqa: E402


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    write_drawn(folder)
    return folder


def test_folds_leave_each_picture_out_once(drawn):
    pictures = expert_pictures(drawn)
    assert [p.name for p in pictures] == [str(k) for k in range(1, 11)]
    left_out, beside = [], left_out_by(dataclasses.replace(TINY, folds=3), 10)
    assert beside[0] == ((0, 0), range(0))
    for k in range(1, 4):
        used, held = folds(pictures, k, 3)
        assert not {p.name for p in used} & {p.name for p in held}
        assert len(used) + len(held) == 10
        left_out += [p.name for p in held]
        assert beside[k][0] == (k, 3) and [pictures[n] for n in beside[k][1]] == list(held)
    assert left_out == [p.name for p in pictures]


@pytest.mark.parametrize(("ground", "vessel"), [(0, 1), (0, 255), (1, 2), (40, 90)])
def test_of_two_values_the_larger_is_vessel(drawn, tmp_path, ground, vessel):
    drawn_so = cv2.imread(str(drawn / "3_gt.png"), cv2.IMREAD_UNCHANGED) > 0
    cv2.imwrite(str(tmp_path / "3_gt.png"), np.where(drawn_so, vessel, ground).astype(np.uint8))
    shutil.copy(drawn / "3.png", tmp_path)
    (one,) = expert_pictures(tmp_path)
    assert np.array_equal(one.mask, drawn_so)


@pytest.mark.parametrize(("change", "said"), [
    (lambda m: 0 * m, "nothing is drawn in it: every pixel is 0"),
    (lambda m: 0 * m + 255, "nothing is drawn in it: every pixel is 255"),
    (lambda m: 255 - m, "of it is drawn as vessel"),
    (lambda m: np.where(m > 0, 1, 0) + np.eye(*m.shape), "of more than two values none is"),
])  # fmt: skip
def test_a_mask_that_is_none_is_refused_by_name(drawn, tmp_path, change, said):
    mask = cv2.imread(str(drawn / "3_gt.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "3_gt.png"), change(mask).astype(np.uint8))
    shutil.copy(drawn / "3.png", tmp_path)
    with pytest.raises(ImageError, match=f"3_gt.png: .*{said}"):
        expert_pictures(tmp_path)
    grey = np.linspace(0, 255, mask.size).reshape(mask.shape)
    cv2.imwrite(str(tmp_path / "grey.png"), np.where(mask > 0, 200, grey / 3).astype(np.uint8))
    assert np.array_equal(expert_mask(tmp_path / "grey.png"), mask > 0)


@pytest.mark.slow
def test_what_is_no_fold(drawn):
    options = dataclasses.replace(TINY, real=str(drawn), fold=(2, 3))
    pictures = expert_pictures(drawn)
    assert len(real_pictures(options.real, options.fold)) == len(folds(pictures, 2, 3)[0])
    for fold in ((0, 3), (4, 3), (1, 1)):
        with pytest.raises(UsageError, match="fold"):
            real_pictures(options.real, fold)
    with pytest.raises(UsageError, match="fold 1/3 is of real pictures: give --real"):
        real_pictures("", (1, 3))
    with pytest.raises(UsageError, match="must be K/N"):
        chosen("cpu", {"fold": "first"})
    with pytest.raises(ImageError, match=r"no N\.png"):
        expert_pictures(drawn.parent / "nothing")
    for of, fold, count in ((1, (0, 0), 10), (11, (0, 0), 10), (2, (0, 0), 0), (2, (1, 3), 10)):
        with pytest.raises(UsageError, match=f"folds {of}: must be 2 .. {count}"):
            left_out_by(dataclasses.replace(TINY, folds=of, fold=fold), count)


@pytest.mark.slow
def test_a_network_beside_learns_nothing_of_what_it_leaves_out(tmp_path):
    """Another picture in its own part changes the others, and not this one."""
    write_drawn(tmp_path / "real", 4)
    options = dataclasses.replace(
        TINY, real=str(tmp_path / "real"), folds=2, real_share=1.0, batch=4, crop=64
    )
    train(tmp_path / "one", options)
    shutil.copytree(tmp_path / "real", tmp_path / "other")
    for k in (1, 2):
        cv2.imwrite(
            str(tmp_path / "other" / f"{k}.png"),
            np.random.default_rng(k).integers(0, 255, (200, 220), np.uint8),
        )
    train(tmp_path / "two", dataclasses.replace(options, real=str(tmp_path / "other")))
    same = {}
    for name in ("", "fold-1-of-2", "fold-2-of-2"):
        one, two = (
            load_file(tmp_path / k / name / "checkpoint.safetensors") for k in ("one", "two")
        )
        same[name] = all(torch.equal(one[key], two[key]) for key in one if key.startswith("net."))
        told = json.loads((tmp_path / "one" / name / "manifest.json").read_text())
        assert told["options"]["fold"] == ([int(name[5]), 2] if name else [0, 0])
    assert same == {"": False, "fold-1-of-2": True, "fold-2-of-2": False}
