"""A graph whose convolutions go block by block says what the whole one says."""

import numpy as np
import onnx
import onnxruntime as ort
import pytest

from gcar_deploy.predict.encoding import encode, flat_inputs, input_names
from gcar_deploy.predict.hull import Candidates
from gcar_export.shipping.export_onnx import DeployedSparse, _trace_sparse
from gcar_export.shipping.row_blocks import BLOCKS, in_blocks
from gcar_export.training.dataset import training_scene
from gcar_export.training.networks.sparse import SparseConfig, SparsePredictor

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def graphs(tmp_path_factory):
    """The same network of two stages, whole and in blocks; both files."""
    torch.manual_seed(2)
    net = SparsePredictor(SparseConfig(width=(5, 4, 3, 2), stages=2, ray_width=2)).eval()
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    folder = tmp_path_factory.mktemp("blocks")
    _trace_sparse(DeployedSparse(net).eval()).save(str(folder / "whole.onnx"))
    model = onnx.load(str(folder / "whole.onnx"))
    # The finest level convolves twice a stage, and so does each coarser one.
    assert in_blocks(model) == 2 * 2 * len(BLOCKS)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(folder / "blocks.onnx"))
    return folder / "whole.onnx", folder / "blocks.onnx"


@pytest.mark.parametrize("points", [1, 3, 8, 9, 500])
def test_answers_are_the_same_to_the_last_bit(graphs, points):
    scene = training_scene(70_100, 1)
    hull = Candidates(scene.hull.index[:points], scene.points_mm[:points], scene.hull.lattice)
    feed = dict(zip(input_names(), flat_inputs(encode(hull, scene.views)), strict=True))
    whole, blocks = (ort.InferenceSession(str(path)).run(None, feed)[0] for path in graphs)
    assert len(whole) == points and np.ptp(whole) > 0
    assert np.array_equal(whole, blocks)


def test_what_is_in_blocks_is_left_alone(graphs):
    model = onnx.load(str(graphs[1]))
    before = model.SerializeToString()
    assert in_blocks(model) == 0
    assert model.SerializeToString() == before
