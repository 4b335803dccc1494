"""Generated angiograms, the segmentation network's training, and its way into the runtime."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from gcar_deploy.config import ImagingOptions  # noqa: E402
from gcar_deploy.errors import ModelError  # noqa: E402
from gcar_deploy.imaging.extract import extract_vessels  # noqa: E402
from gcar_deploy.imaging.learned import learned_vessels, support  # noqa: E402
from gcar_deploy.imaging.net import (  # noqa: E402
    KIND,
    Seen,
    Segmenter,
    at_network_size,
    load_segmenter,
    net_input,
    open_segmenter,
)
from gcar_deploy.models import Kind, read_model  # noqa: E402
from gcar_deploy.predict.kinds import read_predictor  # noqa: E402
from gcar_export.scenes.angiogram_vessels import Vessels, catheter, random_vessels, ribbon  # noqa: E402
from gcar_export.scenes.angiograms import (  # noqa: E402
    SIDE,
    asked_of,
    generated_angiogram,
    training_pair,
)
from gcar_export.scenes.augmented import Labelled, augmented_pair  # noqa: E402
from gcar_export.scenes.expert_pictures import expert_pair, expert_pictures  # noqa: E402
from gcar_export.scenes.picture_pool import pooled  # noqa: E402
from gcar_export.scenes.protocols import clinical_geometry  # noqa: E402
from gcar_export.scenes.raw_angiograms import raw_angiogram  # noqa: E402
from gcar_export.scenes.render import path_lengths  # noqa: E402
from gcar_export.scenes.trees import any_style, random_tree  # noqa: E402
from gcar_export.shipping.export_segmenter import _GroupNorm, export_segmenter  # noqa: E402
from gcar_export.training.networks.mask_unet import MaskUNet, MaskUNetConfig  # noqa: E402
from gcar_export.training.segmenter import (  # noqa: E402
    TINY,
    Stream,
    chord_loss,
    line_loss,
    mask_loss,
    real_pictures,
    total_loss,
    train,
)
from gcar_export.training.segmenter_start import begin_with  # noqa: E402
from tests.export.drawn_angiograms import write_drawn  # noqa: E402
from tests.imaging.phantoms import angiogram, raw_picture, tube_paths  # noqa: E402


def test_pictures_are_functions_of_their_number():
    a, b, c = (generated_angiogram(5, i) for i in (0, 0, 1))
    np.testing.assert_array_equal(a.pixels, b.pixels)
    assert (a.pixels != c.pixels).any()
    assert a.pixels.dtype == np.uint8 and a.pixels.shape == (SIDE, SIDE)


def test_vessels_are_darker_than_what_surrounds_them():
    darker = []
    for i in range(12):
        made = generated_angiogram(6, i)
        near = cv2.dilate(made.mask.astype(np.uint8), np.ones((9, 9))) > 0
        ring = near & ~(cv2.dilate(made.mask.astype(np.uint8), np.ones((5, 5))) > 0)
        darker.append(made.pixels[made.mask].mean() < made.pixels[ring].mean())
        assert 0.001 < made.mask.mean() < 0.6
        assert not (made.mask & (made.unsure | made.device)).any()
        assert (made.path_px[made.mask] > 0.5).all() and made.path_px.max() < SIDE
    assert np.mean(darker) > 0.9


def test_chords_are_those_of_a_round_tube():
    """Half-way along a drawn ribbon the profile is near sqrt(1 - x^2), its middle the width."""
    out = np.zeros((80, 80), np.float32)
    ribbon(out, np.array([[10.0, 40.0], [70.0, 40.0]]), 12.0, 12.0)
    profile = out[:, 40]
    x = (np.arange(80) - 39.6) / 6.0  # drawn a fraction of a pixel off, picture and truth alike
    true = 12 * np.sqrt(np.clip(1 - x * x, 0, None))
    assert profile.max() == pytest.approx(12, rel=0.05)
    assert np.abs(profile - true)[np.abs(x) < 0.8].max() < 2.0
    assert abs(profile.sum() - true.sum()) < 0.2 * true.sum()
    assert not out[:, :3].any() and not out[:, 77:].any()


def test_a_catheter_comes_from_a_border_and_is_no_vessel():
    rng = np.random.default_rng(3)
    for _ in range(3):
        vessels = random_vessels(rng, SIDE, 0.4)
        assert np.hypot(*vessels.heading) == pytest.approx(1)
        assert vessels.path_px.min() >= 0 and vessels.path_px.max() > 2
    still = Vessels(
        path_px=np.zeros((SIDE, SIDE), np.float32),
        doubtful=np.zeros((SIDE, SIDE), bool),
        ostium=np.array([128.0, 128.0]),
        heading=np.array([0.0, 1.0]),
    )
    rim = np.ones((SIDE, SIDE), bool)
    rim[2:-2, 2:-2] = False
    for k in range(8):
        tube, spill = catheter(np.random.default_rng(k), still, 0.4)
        assert (tube[rim] > 0.2).any() and 0.4 < tube.max() < 3.0 / 0.4 and spill.min() >= 0


def test_input_and_truth_belong_together():
    """The network's own channels are larger on vessel than off it, flips included."""
    for i in range(4):
        channels, truth = training_pair(7, i)
        assert channels.shape == (3, SIDE, SIDE) and channels.dtype == np.float32
        assert truth.shape == (6, SIDE, SIDE) and truth.dtype == np.float32
        vessel, asked, chord, device, known, line = truth
        assert set(np.unique(vessel)) <= {0.0, 1.0} and set(np.unique(asked)) <= {0.0, 1.0}
        assert 0 < line.sum() < 0.5 * vessel.sum() and (vessel[line > 0] == 1).all()
        assert (chord[vessel > 0] > 0.5).all() and (asked[vessel > 0] == 1).all()
        assert not (vessel * device).any() and (known[vessel + device > 0] == 1).all()
        on, off = channels[:, vessel > 0].mean(axis=1), channels[:, chord == 0].mean(axis=1)
        assert (on > off).all()


def test_input_does_not_depend_on_gain_or_offset():
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.normal(size=(64, 80)).astype(np.float32), (0, 0), 2)
    holes = np.zeros((64, 80), bool)
    holes[:4] = True
    one = net_input(picture, holes)
    other = net_input(7 * picture + 3, holes)
    np.testing.assert_allclose(one, other, atol=2e-3)
    assert not one[:, :4].any() and np.isfinite(one).all()


def test_losses_are_least_at_the_truth():
    torch.manual_seed(0)
    truth = (torch.rand(2, 20, 20) > 0.7).float()
    weight = (torch.rand(2, 20, 20) > 0.2).float()
    right = 20 * (truth - 0.5)
    assert mask_loss(right, truth, weight) < 0.05 < 1 < mask_loss(-right, truth, weight)
    # What has no weight is asked neither way.
    other = torch.where(weight > 0, right, -right)
    torch.testing.assert_close(mask_loss(other, truth, weight), mask_loss(right, truth, weight))
    chord = 5 * torch.rand(2, 20, 20)
    assert chord_loss(chord, chord, weight) == 0 < chord_loss(chord + 0.1, chord, weight)
    both = torch.stack([right, chord, -right], 1)
    line = truth * (torch.rand(2, 20, 20) > 0.5)
    truths = torch.stack([truth, weight, chord, 1 - truth, weight, line], 1)
    assert total_loss(both, truths) < 0.1
    assert line_loss(right, line) < 0.01 < 0.95 < line_loss(-right, line)
    assert line_loss(-right, 0 * line) == 0  # nothing to find, nothing lost
    # Where nothing is known of devices, nothing is asked.
    unknown = torch.stack([truth, weight, chord, 0 * truth, 0 * weight, line], 1)
    torch.testing.assert_close(
        total_loss(torch.stack([right, chord, right], 1), unknown), total_loss(both, unknown)
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("segmenter")
    train(out / "run", TINY)
    worst = export_segmenter(out / "run" / "checkpoint.safetensors", out / "tiny.onnx", 2)
    assert worst < 1e-4
    return out


@pytest.mark.slow
def test_training_goes_on_where_it_stopped(trained, tmp_path):
    from safetensors.torch import load_file

    options = TINY
    train(tmp_path, options.__class__(**{**options.__dict__, "steps": 2, "decay_steps": 1}))
    assert json.loads((tmp_path / "manifest.json").read_text())["step"] == 2
    train(tmp_path, options)
    done = load_file(tmp_path / "checkpoint.safetensors")
    assert int(done["step"]) == 3
    assert json.loads((tmp_path / "manifest.json").read_text())["validation"]["dice"] >= 0


@pytest.mark.slow
def test_the_runtime_reads_and_runs_it(trained):
    segmenter = open_segmenter(trained / "tiny.onnx", threads=1)
    rng = np.random.default_rng(1)
    seen = segmenter.look(rng.normal(size=(3, 61, 83)).astype(np.float32))
    assert seen.probability.shape == seen.chord.shape == (61, 83)
    assert (seen.probability >= 0).all() and (seen.probability <= 1).all()
    assert (seen.chord >= 0).all() and np.isfinite(seen.chord).all()
    with pytest.raises(ModelError, match=r"wants inputs\.channels"):
        read_model(trained / "tiny.onnx", (Kind(KIND.name, "", {**KIND.inputs, "channels": 2}),))
    with pytest.raises(ModelError, match="segmenter"):
        read_predictor(trained / "tiny.onnx")


@pytest.mark.slow
def test_who_is_asked(trained):
    segmenter = open_segmenter(trained / "tiny.onnx", threads=1)
    picture = angiogram(raw_picture(tube_paths()))
    with pytest.raises(ModelError, match="not loaded"):
        extract_vessels(picture, ImagingOptions(segmenter="net"))
    # auto: the classical method finds the tubes, so the network is never asked
    found = extract_vessels(picture, ImagingOptions(segmenter="auto"), segmenter)
    assert found.mask.any()


def test_support_from_a_certain_probability():
    """A drawn line, a faint stroke of its own, and a speck."""
    sure = np.zeros((120, 120), np.float32)
    cv2.line(sure, (10, 60), (110, 60), 0.99, 5)
    cv2.line(sure, (10, 20), (110, 20), 0.9, 5)  # never above the upper threshold
    cv2.circle(sure, (60, 100), 4, 0.99, -1)  # too short to be a vessel
    reach = support(Seen(sure, 5 * sure), (0.7, 0.95))
    assert reach[60, 10:110].all() and not reach[:40].any() and not reach[80:].any()
    assert not support(Seen(0 * sure, sure), (0.7, 0.95)).any()


def test_the_networks_size_is_that_of_the_picture_not_of_its_pixels():
    sides = {(512, 512): 448, (300, 300): 352, (400, 400): 400, (256, 512): 362, (1024, 720): 448}
    for shape, side in sides.items():
        work, holes = at_network_size(np.zeros(shape, np.float32), np.zeros(shape, bool))
        assert work.shape == holes.shape and work.size == pytest.approx(side**2, rel=0.01)
        assert work.shape[0] / work.shape[1] == pytest.approx(shape[0] / shape[1], rel=0.02)
    long = np.zeros((64, 4096), np.float32)
    assert at_network_size(long, long > 0)[0].shape == (16, 1024)


@pytest.mark.slow
def test_lines_are_looked_at_at_the_size_they_were_learned_at():
    asked = []

    class Watched(Segmenter):
        def look(self, channels):
            asked.append(channels.shape[1:])
            return super().look(channels)

        def devices(self, lines):
            asked.append(lines.pixels.max() < 352)
            return super().devices(lines)

    for side in (300, 512):
        picture = np.zeros((side, side), np.float32)
        cv2.line(picture, (20, 20), (side - 20, side - 60), 1.0, 9)
        picture = cv2.GaussianBlur(picture, (0, 0), 1.5)
        net = Watched(load_segmenter("net", 1).session)
        learned_vessels({"display": picture}, np.zeros((side, side), bool), 0.3, net)
    assert asked == [(352, 352), True, (448, 448), True]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    write_drawn(folder)
    return folder


def test_crops_of_real_pictures_keep_picture_and_mask_together(drawn):
    pictures = expert_pictures(drawn)
    seen = 0
    for index in range(8):
        channels, truth, number = expert_pair(pictures, 1, index)
        assert 0 <= number < len(pictures)
        assert channels.shape == (3, SIDE, SIDE) and truth.shape == (6, SIDE, SIDE)
        vessel, asked, chord, device, known, _ = truth
        assert not device.any() and (chord[asked == 0] == 0).all()
        assert (known <= cv2.dilate(vessel, np.ones((5, 5)))).all() and (known.sum() > 0) == (
            vessel.sum() > 0
        )
        inner = (cv2.erode(vessel, np.ones((5, 5))) > 0) & (asked > 0)
        outer = (cv2.dilate(vessel, np.ones((9, 9))) == 0) & (asked > 0)
        if inner.sum() > 200:  # a crop's collimator search may have taken the rest
            assert channels[0][inner].mean() > channels[0][outer].mean() + 0.5
            assert chord[inner].mean() > 3
            seen += 1
    assert seen >= 2


@pytest.mark.slow
def test_a_step_holds_real_and_generated_pictures(drawn, tmp_path):
    options = dataclasses.replace(TINY, batch=4, real=str(drawn), real_share=0.5, crop=128)
    stream = Stream(options, tmp_path, real_pictures(options.real, options.fold))
    known = [float(stream[k][1][4].mean()) for k in range(4)]
    assert max(known[:2]) < 0.5 < min(known[2:])  # of devices, real pictures tell little
    assert stream[0][0].shape == (3, 128, 128) and stream[3][1].shape == (6, 128, 128)
    assert len(list(tmp_path.iterdir())) <= TINY.pictures


def test_a_pooled_picture_is_drawn_once_and_never_used_twice_alike(tmp_path):
    one = pooled(tmp_path, 5, 1)
    again = pooled(tmp_path, 5, 1)
    made = generated_angiogram(5, 1)
    for found in (one, again):
        np.testing.assert_array_equal(found.pixels, made.pixels)
        np.testing.assert_allclose(found.asked, asked_of(made), rtol=1e-3, atol=1e-4)
    assert len(list(tmp_path.iterdir())) == 1
    pairs = [augmented_pair(np.random.default_rng(k), one) for k in (0, 0, 1)]
    np.testing.assert_array_equal(pairs[0][0], pairs[1][0])
    assert (pairs[0][0] != pairs[2][0]).any()


@pytest.mark.slow
def test_of_two_pooled_pictures_one_shows_a_tree_in_space(tmp_path):
    """Its chords are millimetres of a coronary artery in pixels, its vessels dark."""
    shown = [pooled(tmp_path, 5, k) for k in range(4)]
    assert [p.pixels.shape[0] for p in shown] == [512, SIDE, 512, SIDE]
    for whole in shown[::2]:
        mask, weight, chord, device, known, line = whole.asked
        pixel_mm = raw_angiogram(np.random.default_rng([5, 0])).pixel_mm
        near = cv2.dilate(mask, np.ones((25, 25))) > 0
        assert whole.pixels[mask > 0].mean() < whole.pixels[near & (chord == 0)].mean()
        # A vessel of some 1 .. 5 mm is crossed at a slant, and where it turns along the beam.
        assert 0.8 < np.median(chord[line > 0]) * pixel_mm < 5 and chord.max() * pixel_mm < 40
        assert not device.any() and known[mask > 0].all() and (chord[mask > 0] > 0.8).all()
        assert not weight[(chord > 0.25) & (cv2.dilate(mask, np.ones((3, 3))) == 0)].any()
        # At the network's size its vessels are as wide as those of the pictures drawn in the plane.
        assert 0.6 <= whole.zoom[0] < whole.zoom[1] <= 448 / 352


@pytest.mark.slow
def test_most_raw_pictures_show_one_artery_as_an_injection_does():
    """What a picture shows of the whole tree's volume, which hardly hangs on the view."""
    shares = []
    for seed in range(24):
        made = raw_angiogram(np.random.default_rng(seed))
        rng = np.random.default_rng(seed)
        whole = random_tree(rng, any_style(rng))
        seen = path_lengths(clinical_geometry(2)[0][0], *whole.segments())
        shares.append(made.path_px.sum() * made.pixel_mm / seen.sum())
    both = np.array(shares) > 0.88
    assert 1 <= both.sum() <= 10
    assert np.median(np.array(shares)[~both]) < 0.7


def test_vessels_too_faint_to_be_drawn_are_asked_neither_way(monkeypatch):
    """Were all faint, no pixel would be vessel for sure, and all that hold a chord unsure."""
    monkeypatch.setattr("gcar_export.scenes.raw_angiograms.FAINT", 1e3)
    made = raw_angiogram(np.random.default_rng([5, 0]))
    assert not made.mask.any() and made.unsure.sum() > 1000
    np.testing.assert_array_equal(made.unsure, made.path_px > 0.25)


def test_chords_of_an_experts_vessel_are_longer_than_it_is_wide(tmp_path):
    """A bar drawn 12 pixels wide: a round vessel's chord is its width, over what experts draw."""
    mask = np.zeros((300, 300), np.uint8)
    mask[140:152, 20:280] = 255
    cv2.imwrite(str(tmp_path / "1_gt.png"), mask)
    cv2.imwrite(str(tmp_path / "1.png"), 200 - mask // 2)
    (one,) = expert_pictures(tmp_path)
    assert one.path_px[143:149, 60:240].max() == pytest.approx(12 / 0.6, rel=0.08)
    assert not one.path_px[:138].any()


def test_picture_and_truth_are_moved_alike():
    """Of a disc the area grows with the square of the zoom, its chord with the zoom."""
    disc = np.hypot(*(np.indices((256, 256)) - 127.5)) < 30
    asked = np.stack([disc, disc | True, 40 * disc, disc & False, disc | True, disc & False])
    pixels = np.where(disc, 60.0, 180.0).astype(np.float32)
    for k in range(6):
        zoom = 0.8 + 0.1 * k
        given = Labelled(pixels, asked.astype(np.float32), (zoom, zoom + 1e-6))
        channels, truth = augmented_pair(np.random.default_rng(k), given)
        assert truth[0].sum() == pytest.approx(zoom**2 * disc.sum(), rel=0.2)
        assert truth[2].max() == pytest.approx(40 * zoom, rel=1e-3)
        inside = truth[1] > 0
        assert (
            channels[1][(truth[0] > 0) & inside].mean()
            > channels[1][(truth[0] == 0) & inside].mean()
        )


@pytest.mark.slow
def test_a_model_gives_its_weights_back(trained):
    from safetensors.torch import load_file

    net, other = MaskUNet(), MaskUNet()
    begin_with(net, trained / "tiny.onnx")
    begin_with(other, trained / "run" / "checkpoint.safetensors")
    kept = load_file(trained / "run" / "checkpoint.safetensors")
    means = {name[5:]: value for name, value in kept.items() if name.startswith("mean.")}
    assert means.keys() == net.state_dict().keys()
    for name, value in means.items():
        torch.testing.assert_close(net.state_dict()[name], value)
        torch.testing.assert_close(other.state_dict()[name], value)
    assert any((kept[f"net.{name}"] != value).any() for name, value in means.items())
    small = MaskUNet(MaskUNetConfig(width=(16, 32, 48, 96)))
    with pytest.raises(ModelError, match=r"does not hold|channels"):
        begin_with(small, trained / "tiny.onnx")


def test_size_of_the_network():
    assert 1_000_000 < sum(p.numel() for p in MaskUNet().parameters()) < 2_000_000


def test_the_exported_norm_is_the_trained_one():
    norm = torch.nn.GroupNorm(4, 20)
    with torch.no_grad():
        norm.weight.uniform_(0.5, 2.0)
        norm.bias.uniform_(-1.0, 1.0)
    x = 3.0 + torch.randn(1, 20, 24, 40) * torch.linspace(0.01, 5.0, 20)[None, :, None, None]
    torch.testing.assert_close(_GroupNorm(norm)(x), norm(x), rtol=1e-4, atol=1e-5)
