"""The TTT layer: its heads, its mask, and a state that is a value."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from splatpainter.nn.fast_weights import FastWeights
from splatpainter.nn.ttt import TTTLayer

DIM, HIDDEN = 16, 24


def layer(**settings) -> TTTLayer:
    torch.manual_seed(0)
    made = TTTLayer(DIM, HIDDEN, **settings)
    for name, parameter in made.named_parameters():
        if name not in ("w0", "w1", "w2", "gain"):
            torch.nn.init.normal_(parameter, std=0.4)  # large enough that every term shows
    return made


def tokens(count: int = 20, seed: int = 1) -> Tensor:
    return torch.randn(count, DIM, generator=torch.Generator().manual_seed(seed))


def same(a: FastWeights, b: FastWeights) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def written_out(made: TTTLayer, x: Tensor, steps: int) -> FastWeights:
    """An update of one head, from autograd of its loss and torch's own decomposition of what comes out."""
    kv = functional.silu(x @ made.kv.weight.T)
    k, v = kv[:, :DIM], kv[:, DIM:]
    k = k / (k.norm(dim=1, keepdim=True) + 1e-5)
    # softplus of 0 plus its inverse at 0.01
    rates = functional.softplus(x @ made.rates.weight.T + torch.tensor(0.01).expm1().log())
    weights = [w[0].detach() for w in (made.w0, made.w1, made.w2)]
    norms = [w.norm(dim=0) for w in weights]
    for _ in range(steps):
        gradients = []
        for m in range(3):
            free = [w.clone().requires_grad_() for w in weights]
            prediction = (functional.silu(k @ free[0]) * (k @ free[2])) @ free[1]
            gain = (rates[:, m].detach() * -0.5 * ((prediction - v) ** 2).sum(1)).sum()
            gradients.append(torch.autograd.grad(gain, free[m])[0])
        for m, gradient in enumerate(gradients):
            left, values, right = torch.linalg.svd(gradient / gradient.norm(), full_matrices=False)
            for _ in range(5):
                values = 3.4445 * values - 4.7750 * values**3 + 2.0315 * values**5
            moved = weights[m] + left @ torch.diag(values) @ right
            weights[m] = moved * (norms[m] / moved.norm(dim=0))
    return FastWeights(*weights)


@pytest.mark.parametrize("steps", [1, 3])
def test_update_and_read_are_the_written_out_formulas(steps: int) -> None:
    made, x = layer(inner_loss="l2", inner_steps=steps), tokens()
    state = made.update(made.initial_state(), x)
    expected = written_out(made, x, steps)
    for a, b in zip(state, expected, strict=True):
        torch.testing.assert_close(a[0], b, atol=1e-3, rtol=1e-3)
    q = functional.silu(made.queries["voxel"](x))
    q = q / (q.norm(dim=1, keepdim=True) + 1e-5)
    prediction = (functional.silu(q @ state.w0[0]) * (q @ state.w2[0])) @ state.w1[0]
    prediction = prediction / (prediction.pow(2).mean(1, keepdim=True) + 1e-5).sqrt() * made.gain
    torch.testing.assert_close(made.read(state, x, "voxel"), prediction @ made.out.weight.T, atol=1e-5, rtol=1e-4)


def test_the_streams_have_queries_of_their_own() -> None:
    made, x = layer(), tokens()
    state = made.initial_state()
    assert (made.read(state, x, "image") - made.read(state, x, "voxel")).abs().max() > 0.1
    made.queries["image"].load_state_dict(made.queries["voxel"].state_dict())
    assert torch.equal(made.read(state, x, "image"), made.read(state, x, "voxel"))
    alone = layer(streams=("voxel",))
    assert "queries.image.weight" not in alone.state_dict()


def test_masked_tokens_are_not_there() -> None:
    made, x = layer(inner_loss="l2"), tokens()
    mask = torch.arange(20) < 12
    short = made.update(made.initial_state(), x[:12])
    ill = x.clone()
    ill[12:] = torch.nan
    for other in (x, ill):
        masked = made.update(made.initial_state(), other, mask)
        for a, b in zip(masked, short, strict=True):
            torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


def test_two_halves_of_a_token_are_one_token() -> None:
    made, x = layer(inner_loss="l2"), tokens()
    complete = made.update(made.initial_state(), x)
    mask = torch.tensor([0.5] * 8 + [1.0] * 12 + [0.5] * 8)
    halves = made.update(made.initial_state(), torch.cat([x, x[:8]]), mask)
    for a, b in zip(complete, halves, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


def test_an_edit_of_nothing_returns_the_same_bits() -> None:
    made = layer()
    state = made.update(made.initial_state(), tokens())
    assert same(made.update(state, tokens(seed=2), torch.zeros(20)), state)
    assert same(made.update(state, tokens(seed=2), torch.zeros(20, dtype=torch.bool)), state)
    assert same(made.update(state, tokens(0)), state)
    assert same(made.update(state, tokens(seed=2), edit_strength=0.0), state)


def test_the_state_is_a_value() -> None:
    """The second edit starts where the first ended; going back to a kept state is undo, bit for bit."""
    made = layer()
    first = made.update(made.initial_state(), tokens())
    copies = FastWeights(*(w.detach().clone() for w in first))
    second = made.update(first, tokens(seed=2))
    assert same(first, copies)
    assert not same(second, made.update(made.initial_state(), tokens(seed=2)))
    assert same(made.update(copies, tokens(seed=2)), second)
    reference = layer()
    assert same(made.initial_state(), reference.initial_state())


def test_the_order_of_an_edits_tokens_does_not_matter() -> None:
    made, x = layer(inner_loss="l2"), tokens()
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    state, turned = (made.update(made.initial_state(), y) for y in (x, x[order]))
    for a, b in zip(state, turned, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(made.read(state, x[order], "image"), made.read(state, x, "image")[order])


def test_heads_work_on_slices_of_the_width() -> None:
    """Two heads: nothing of the second head's fast weights reaches the first head's half of the output."""
    made, x = layer(heads=2), tokens()
    assert made.w0.shape == (2, DIM // 2, HIDDEN)
    with torch.no_grad():
        made.out.weight.copy_(torch.eye(DIM))
    state = made.initial_state()
    changed = FastWeights(*(torch.cat([w[:1], w[1:] * torch.linspace(0.5, 2, w.shape[-1])]) for w in state))
    a, b = made.read(state, x, "image"), made.read(changed, x, "image")
    assert torch.equal(a[:, : DIM // 2], b[:, : DIM // 2]) and (a != b)[:, DIM // 2 :].any()
    assert made.update(state, x).w1.shape == (2, HIDDEN, DIM // 2)


def test_rates_start_at_a_hundredth() -> None:
    made = layer()
    torch.nn.init.zeros_(made.rates.weight)
    torch.testing.assert_close(made._rates(tokens(), made.rates), torch.full((1, 20, 3), 0.01))


def test_rates_are_exact_also_under_autocast() -> None:
    made = layer()
    exact = made._rates(tokens(), made.rates)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(made._rates(tokens(), made.rates), exact)


def test_training_reaches_every_weight() -> None:
    made = layer(inner_loss="l2", inner_steps=2)
    state = made.update(made.initial_state(), tokens(), torch.linspace(0, 1, 20))
    out = made.read(state, tokens(seed=3), "voxel") + made.read(state, tokens(seed=3), "image")
    out.pow(2).sum().backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.norm() > 0, name


def test_bf16_autocast_follows_float32() -> None:
    made, x = layer(inner_loss="l2"), tokens()
    exact = made.update(made.initial_state(), x)
    prediction = made.read(exact, x, "voxel")
    with torch.autocast("cpu", torch.bfloat16):
        state = made.update(made.initial_state(), x)
        half = made.read(exact, x, "voxel")
    assert all(w.dtype == torch.float32 for w in state)
    for a, b, first in zip(exact, state, made.initial_state(), strict=True):
        assert (a - b).norm() < 0.25 * (a - first).norm()
    assert (half.float() - prediction).norm() < 0.03 * prediction.norm()


def test_heads_must_divide_the_width() -> None:
    with pytest.raises(ValueError, match="got 16 and 3"):
        layer(heads=3)


@pytest.mark.parametrize("chunk", [1, 7, 19, 20, 50])
@pytest.mark.parametrize("masked", [False, True])
def test_an_edit_in_parts_is_the_edit(chunk: int, masked: bool) -> None:
    made, x = layer(inner_loss="l2", inner_steps=2), tokens()
    mask = torch.linspace(0, 1, len(x)) if masked else None
    complete = made.update(made.initial_state(), x, mask)
    parts = made.update(made.initial_state(), x, mask, chunk=chunk)
    for one, two in zip(parts, complete, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-4)
