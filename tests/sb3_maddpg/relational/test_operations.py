"""Operations of relational networks against PyTorch's in double precision."""

import pytest
import torch as th
from torch.nn import functional as F

from sb3_maddpg.relational.operations import Linear, largest, linear


def close(actual, expected):
    assert actual.shape == expected.shape
    th.testing.assert_close(actual.double(), expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(3, 5), (200, 105), (96, 14, 6), (10, 4, 13, 77), (150, 1)])
@pytest.mark.parametrize("out", [1, 2, 64])
@pytest.mark.parametrize("layout", ["contiguous", "columns", "transposed", "expanded"])
def test_a_linear_layer_and_its_gradients(shape, out, bias, layout):
    th.manual_seed(0)
    x, weight = th.randn(shape), th.randn(out, shape[-1])
    if layout == "columns":  # of wider tensors
        x, weight = th.cat([x, x, x], dim=-1)[..., : shape[-1]], th.cat([weight, weight], dim=1)[:, : shape[-1]]
    elif layout == "transposed":
        x, weight = x.mT.contiguous().mT, weight.mT.contiguous().mT
    elif layout == "expanded":
        x = x[:1].expand(shape)
    given = [x, weight, th.randn(out) if bias else None]
    single = [None if one is None else one.detach().requires_grad_() for one in given]
    double = [None if one is None else one.detach().double().requires_grad_() for one in given]
    close(linear(*single), F.linear(*double))
    # A mean's gradient is an expanded number
    for loss in (lambda y: y.mean(), lambda y: y.mT.square().sum()):
        actual = th.autograd.grad(loss(linear(*single)), [one for one in single if one is not None])
        expected = th.autograd.grad(loss(F.linear(*double)), [one for one in double if one is not None])
        for pair in zip(actual, expected, strict=True):
            close(*pair)


def test_the_layer_gives_gradients_to_what_needs_them_and_may_be_changed_in_place():
    layer = Linear(6, 4)
    x = th.randn(50, 4, 6)
    output = layer(x).add_(1.0).relu_()
    assert output._base is None, "a view, whose gradient autograd would copy"
    output.sum().backward()
    assert x.grad is None
    expected = (F.linear(x, layer.weight, layer.bias) > -1).float().sum(dim=(0, 1))
    th.testing.assert_close(layer.bias.grad, expected)
    layer.requires_grad_(False)
    wanted = th.randn(50, 4, 6, requires_grad=True)
    layer(wanted).sum().backward()
    th.testing.assert_close(wanted.grad, layer.weight.sum(dim=0).expand(50, 4, 6))


@pytest.mark.skipif(not th.backends.mkldnn.is_available(), reason="PyTorch was built without oneDNN")
def test_onednn_multiplies_where_it_is_faster_and_nowhere_else():
    layer = Linear(6, 4)

    def by_onednn(layer, x):
        return "_LinearBackward" in layer(x).grad_fn.name()

    assert by_onednn(layer, th.randn(128, 6))
    assert by_onednn(layer, th.randn(2, 64, 6))
    assert not by_onednn(layer, th.randn(127, 6))
    with th.autocast("cpu", th.bfloat16):
        assert layer(th.randn(128, 6)).dtype == th.bfloat16
    assert not by_onednn(layer.double(), th.randn(128, 6, dtype=th.float64))
    script = th.jit.trace(layer.float(), th.randn(128, 6))
    assert "mkldnn" not in str(script.inlined_graph)


def test_the_largest_and_who_gets_its_gradient():
    x = th.tensor([[[1.0, 5.0], [3.0, 5.0], [2.0, 4.0]]], requires_grad=True)
    result = largest(x)
    assert result.tolist() == [[3.0, 5.0]]
    (gradient,) = th.autograd.grad(result, x, th.tensor([[7.0, 9.0]]))
    assert gradient.tolist() == [[[0.0, 9.0], [7.0, 9.0], [0.0, 0.0]]]
    x = th.randn(20, 3, 13, 8, requires_grad=True)
    gradients = [th.autograd.grad(function(x).square().sum(), x)[0] for function in (largest, lambda y: y.amax(-2))]
    assert th.equal(*gradients)


def test_exported_programs_hold_for_any_number_of_rows():
    class Net(th.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = Linear(6, 4)

        def forward(self, x):
            return largest(self.layer(x))

    net = Net()
    script = th.jit.trace(net, th.randn(2, 1, 6))
    program = th.export.export(net, (th.randn(2, 1, 6),), dynamic_shapes=({0: th.export.Dim("batch")},)).module()
    for rows in (1, 2, 7, 500):
        x = th.randn(rows, 1, 6)
        for exported in (script, program):
            th.testing.assert_close(exported(x), F.linear(x, net.layer.weight, net.layer.bias).amax(dim=-2))
