"""The fast-weight update against autograd of its objective, the singular value decomposition and exact promises."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatpainter.nn import fast_weights
from splatpainter.nn.fast_weights import FastWeights, ascent, column_norms, initial, newton_schulz, step

TOKENS, DIM, HIDDEN = 30, 8, 20


def state(heads: int | None = None, dtype: torch.dtype = torch.float32) -> FastWeights:
    made = initial(DIM, HIDDEN, heads, torch.Generator().manual_seed(0))
    return FastWeights(*(w.to(dtype) for w in made))


def edit(heads: int | None = None, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    """Keys, values, rates."""
    generator = torch.Generator().manual_seed(1)
    lead = (TOKENS,) if heads is None else (heads, TOKENS)
    k, v = (torch.randn(*lead, DIM, generator=generator, dtype=torch.float64).to(dtype) for _ in range(2))
    return k, v, 0.01 * torch.rand(*lead, 3, generator=generator, dtype=torch.float64).to(dtype)


def objective(weights: FastWeights, k: Tensor, v: Tensor, rate: Tensor, loss: str) -> Tensor:
    """What an edit improves, token by token from its definition. rate: [T]."""
    total = torch.zeros((), dtype=k.dtype)
    for key, value, weight in zip(k, v, rate, strict=True):
        gate = key @ weights.w0
        prediction = ((gate / (1 + torch.exp(-gate))) * (key @ weights.w2)) @ weights.w1
        total = total + weight * (prediction @ value if loss == "dot" else -0.5 * ((prediction - value) ** 2).sum())
    return total


@pytest.mark.parametrize("loss", ["dot", "l2"])
def test_ascent_is_the_gradient_of_the_written_out_objective(loss: fast_weights.InnerLoss) -> None:
    k, v, rates = edit(dtype=torch.float64)
    ours = ascent(state(dtype=torch.float64), k, v, rates, loss)
    for m in range(3):  # each matrix has rates of its own
        weights = FastWeights(*(w.requires_grad_() for w in state(dtype=torch.float64)))
        (expected,) = torch.autograd.grad(objective(weights, k, v, rates[:, m], loss), weights[m])
        torch.testing.assert_close(ours[m], expected, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("loss", ["dot", "l2"])
def test_a_small_plain_step_improves_the_objective(loss: fast_weights.InnerLoss) -> None:
    k, v, rates = edit(dtype=torch.float64)
    rates = rates[:, :1].expand(-1, 3)
    before = state(dtype=torch.float64)
    after = FastWeights(*(w + 1e-3 * g for w, g in zip(before, ascent(before, k, v, rates, loss), strict=True)))
    assert objective(after, k, v, rates[:, 0], loss) > objective(before, k, v, rates[:, 0], loss)


@pytest.mark.parametrize("shape", [(12, 30), (30, 12), (20, 20), (3, 12, 30)])
def test_newton_schulz_is_near_the_orthogonal_factor(shape: tuple[int, ...]) -> None:
    matrix = torch.randn(*shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    shares = values / torch.linalg.matrix_norm(matrix)[..., None]
    assert (shares >= 0.002).all()  # what the stated band asks for
    turned = left.mT @ newton_schulz(matrix) @ right.mT  # diagonal if the singular vectors are kept
    diagonal = turned.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(turned, torch.diag_embed(diagonal), atol=1e-10, rtol=0)
    assert (diagonal >= 0.68).all() and (diagonal <= 1.21).all()


def test_newton_schulz_holds_its_band_for_every_singular_value_it_names() -> None:
    """A diagonal matrix is mapped value by value: sweep them."""
    for lead in torch.logspace(-0.31, -2.69, 40, dtype=torch.float64):  # 0.49 .. 0.00204 of the norm
        rest = torch.sqrt((1 - lead**2) / 3).expand(3)
        out = newton_schulz(torch.diag(torch.cat([lead[None], rest]))).diagonal()
        assert (out >= 0.68).all() and (out <= 1.21).all()
    tiny = newton_schulz(torch.diag(torch.tensor([1e-6, 1.0], dtype=torch.float64))).diagonal()
    assert 470 < tiny[0] / 1e-6 < 486
    assert torch.equal(newton_schulz(torch.zeros(3, 5)), torch.zeros(3, 5))


def test_a_step_adds_the_orthogonalised_gradient_and_restores_the_columns() -> None:
    k, v, rates = edit(dtype=torch.float64)
    before = state(dtype=torch.float64)
    after = step(before, k, v, rates, edit_strength=0.5)
    for m, (w, new) in enumerate(zip(before, after, strict=True)):
        free = FastWeights(*(w.clone().requires_grad_() for w in before))
        (gradient,) = torch.autograd.grad(objective(free, k, v, rates[:, m], "dot"), free[m])
        left, values, right = torch.linalg.svd(gradient / gradient.norm(), full_matrices=False)
        for _ in range(5):  # the iteration acts on each singular value alone
            values = 3.4445 * values - 4.7750 * values**3 + 2.0315 * values**5
        expected = w + 0.5 * left @ torch.diag(values) @ right
        expected = expected / expected.pow(2).sum(0).sqrt() * w.pow(2).sum(0).sqrt()
        torch.testing.assert_close(new, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("settings", [{}, {"inner_steps": 5}, {"loss": "l2"}, {"newton_schulz_steps": 0}])
def test_column_norms_survive_edits(settings: dict) -> None:
    before = state()
    after = before
    for _ in range(4):
        after = step(after, *edit(), **settings)
    for a, b in zip(column_norms(before), column_norms(after), strict=True):
        torch.testing.assert_close(a, b, atol=0, rtol=1e-5)
    assert all((w != new).any() for w, new in zip(before, after, strict=True))


def test_given_norms_are_restored() -> None:
    norms = FastWeights(*(2 * n for n in column_norms(state())))
    for expected, w in zip(norms, step(state(), *edit(), norms=norms), strict=True):
        torch.testing.assert_close(w.norm(dim=0, keepdim=True), expected)


def test_five_steps_are_one_step_five_times() -> None:
    repeated = state()
    norms = column_norms(repeated)
    for _ in range(5):
        repeated = step(repeated, *edit(), norms=norms)
    assert all(torch.equal(a, b) for a, b in zip(step(state(), *edit(), inner_steps=5), repeated, strict=True))


@pytest.mark.parametrize("loss", ["dot", "l2"])
def test_an_edit_of_nothing_returns_the_same_bits(loss: fast_weights.InnerLoss) -> None:
    k, v, rates = edit()
    for after in (step(state(), k, v, 0 * rates, loss=loss), step(state(), k, v, rates, loss=loss, edit_strength=0)):
        assert all(torch.equal(a, b) for a, b in zip(state(), after, strict=True))
    none = step(state(), k[:0], v[:0], rates[:0], loss=loss)
    assert all(torch.equal(a, b) for a, b in zip(state(), none, strict=True))


def test_tokens_of_rate_zero_are_not_there() -> None:
    k, v, rates = edit()
    rates[10:] = 0
    for a, b in zip(step(state(), k, v, rates), step(state(), k[:10], v[:10], rates[:10]), strict=True):
        torch.testing.assert_close(a, b, atol=2e-5, rtol=1e-5)


def test_the_size_of_the_rates_cancels_and_their_ratio_does_not() -> None:
    k, v, rates = edit(dtype=torch.float64)
    before = state(dtype=torch.float64)
    once, again = step(before, k, v, rates), step(before, k, v, 100 * rates)
    tilted = step(before, k, v, rates * torch.linspace(0, 2, TOKENS, dtype=torch.float64)[:, None])
    for a, b, c in zip(once, again, tilted, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)
        assert (a - c).norm() > 0.05 * a.norm()


def test_edit_strength_scales_the_way_moved() -> None:
    moved = [
        sum(float((a - b).norm()) for a, b in zip(step(state(), *edit(), edit_strength=s), state(), strict=True))
        for s in (0.1, 0.3, 1.0)
    ]
    assert 2 < moved[1] / moved[0] < 3.2 and moved[2] > 1.5 * moved[1]


def test_heads_do_not_know_each_other() -> None:
    together = step(state(2), *edit(2), loss="l2", inner_steps=2)
    for head in range(2):
        alone = step(FastWeights(*(w[head] for w in state(2))), *(x[head] for x in edit(2)), loss="l2", inner_steps=2)
        for a, b in zip(together, alone, strict=True):
            torch.testing.assert_close(a[head], b, atol=1e-5, rtol=1e-5)


def test_a_step_is_differentiable_in_everything_that_training_moves() -> None:
    """Central differences in float64; column norms are constants of the step, so they are given."""
    k, v, rates = (x[:6].requires_grad_() for x in edit(dtype=torch.float64))
    weights = FastWeights(*(w.requires_grad_() for w in state(dtype=torch.float64)))
    norms = column_norms(weights)

    def after(w0: Tensor, w1: Tensor, w2: Tensor, k: Tensor, v: Tensor, rates: Tensor) -> Tensor:
        # Two Newton-Schulz steps: five amplify small singular values, and with them the differences' error.
        made = step(FastWeights(w0, w1, w2), k, v, rates, loss="l2", newton_schulz_steps=2, norms=norms)
        return torch.cat([(w * torch.arange(w.numel()).view_as(w).sin()).sum()[None] for w in made])

    assert torch.autograd.gradcheck(after, (*weights, k, v, rates), eps=1e-7, atol=1e-4, rtol=1e-3)


def test_gradients_are_finite_where_nothing_is_edited() -> None:
    weights = FastWeights(*(w.requires_grad_() for w in state()))
    k, v, rates = edit()
    after = step(weights, k, v, 0 * rates)
    for gradient in torch.autograd.grad(torch.stack([w.sum() for w in after]).sum(), list(weights)):
        assert gradient.isfinite().all()


def test_arguments_stay_as_they_are_and_runs_agree() -> None:
    before, inputs = state(), edit()
    first = step(before, *inputs)
    assert all(torch.equal(a, b) for a, b in zip(before, state(), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(inputs, edit(), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(first, step(state(), *edit()), strict=True))


def test_the_first_weights_have_their_spread() -> None:
    made = initial(64, 128, 4, torch.Generator().manual_seed(0))
    assert [tuple(w.shape) for w in made] == [(4, 64, 128), (4, 128, 64), (4, 64, 128)]
    for w, fan_in in zip(made, (64, 128, 64), strict=True):  # 32,768 draws: known to 0.4 %
        assert abs(w.std().item() / (2 / fan_in) ** 0.5 - 1) < 0.02


def test_bf16_autocast_follows_float32_and_keeps_a_float32_state() -> None:
    weights, (k, v, rates) = state(), edit()
    exact = step(weights, k, v, rates)
    with torch.autocast("cpu", torch.bfloat16):
        half = step(weights, k, v, rates)
        prediction = fast_weights.apply(half, k)
    for a, b, w in zip(exact, half, weights, strict=True):
        assert b.dtype == torch.float32
        assert (a - b).norm() < 0.2 * (a - w).norm()
    assert prediction.isfinite().all()
