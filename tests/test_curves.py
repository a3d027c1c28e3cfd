"""Curves of sizes and opacities: the line that the decoder undoes, where it spends steps, what it saves."""

import numpy as np
import pytest

from gscodec.encode import companding as curves
from gscodec.encode.companding import Curve


@pytest.fixture
def heard():
    """Values that the picture hears less and less below 0, and their sensitivities."""
    rng = np.random.default_rng(0)
    values = rng.normal(0, 2, 20000)
    return values, np.exp(np.minimum(values, 0)) * rng.gamma(2, size=20000)


def test_a_curve_is_undone(heard):
    curve = curves.fit(*heard)
    values = np.linspace(-20, 20, 999)
    assert np.allclose(curve.values(curve.coded(values)), values, atol=1e-9)
    assert (np.diff(curve.coded(values)) > 0).all()
    assert Curve.of(curve.row()) == curve
    assert np.float32(curve.low) == curve.low
    assert np.float32(curve.width) == curve.width


def test_steps_widen_where_little_is_heard(heard):
    values, weights = heard
    curve = curves.fit(values, weights)
    rise = curve.rise(curve.coded(np.array([-3.0, -1.5, 1.0])))
    assert rise == pytest.approx(np.exp([1.5, 0.75, 0.0]), rel=0.35)  # 1 / sqrt(weight)
    along = weights * curve.rise(curve.coded(values)) ** 2
    low, high = (along[values < -1].mean(), along[values > 0].mean())
    assert low == pytest.approx(high, rel=0.4)


def test_few_gaussians_have_no_curves():
    values = {"log_scales": np.zeros((10, 3)), "logit_opacities": np.zeros((10, 1))}
    assert curves.fit_all(values, values) == {}
