"""The mean of the weights: what it is, and that it is what a checkpoint gives."""

import pytest

torch = pytest.importorskip("torch", reason="needs the export extra")

from gcar_export.training.checkpoint import filled, read_tensors  # noqa: E402
from gcar_export.training.mean_weights import MeanWeights  # noqa: E402
from gcar_export.training.run_folder import RunFolder  # noqa: E402


def one(value):
    net = torch.nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        net.weight.fill_(value)
    return net


def test_plain_at_first_and_exponential_then():
    net = one(0.0)
    mean = MeanWeights(net, 4)
    for step in range(1, 7):
        with torch.no_grad():
            net.weight.fill_(float(step))
        mean.add(net, step)
        if step == 4:
            assert mean.net.weight[0, 0] == pytest.approx(2.5)
    assert mean.net.weight[0, 0] == pytest.approx((2.5 * 0.75 + 5 * 0.25) * 0.75 + 6 * 0.25)
    assert net.weight[0, 0] == 6 and not mean.net.weight.requires_grad
    with pytest.raises(ValueError, match="steps = 0"):
        MeanWeights(net, 0)


@pytest.mark.slow
def test_a_checkpoint_gives_the_mean_and_goes_on_from_both(tmp_path):
    net, mean = one(3.0), one(1.0)
    optimiser = torch.optim.AdamW(net.parameters())
    RunFolder(tmp_path, {"network": "x"}).save(net, optimiser, 7, mean=mean)
    tensors = read_tensors(tmp_path / "checkpoint.safetensors")
    given = one(0.0)
    filled(given, tensors, "c")
    assert given.weight[0, 0] == 1
    again, again_mean = one(0.0), one(0.0)
    folder = RunFolder(tmp_path, {"network": "x"})
    assert folder.resume(again, torch.optim.AdamW(again.parameters()), again_mean) == 7
    assert (again.weight[0, 0], again_mean.weight[0, 0]) == (3, 1)


def test_a_checkpoint_without_a_mean_gives_its_weights(tmp_path):
    net = one(3.0)
    RunFolder(tmp_path, {"network": "x"}).save(net, torch.optim.AdamW(net.parameters()), 7)
    given, mean = one(0.0), one(0.0)
    filled(given, read_tensors(tmp_path / "checkpoint.safetensors"), "c")
    folder = RunFolder(tmp_path, {"network": "x"})
    folder.resume(one(0.0), torch.optim.AdamW(net.parameters()), mean)
    assert given.weight[0, 0] == mean.weight[0, 0] == 3
