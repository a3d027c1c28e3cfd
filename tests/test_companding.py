"""Companding of sizes and opacities: the curve that the decoder expands, and the distribution of its steps."""

import numpy as np
import pytest

from gscodec.encode.companding import Curve, fit, fit_all
from gscodec.encode.settings import CompandingSettings

SETTINGS = CompandingSettings()


@pytest.fixture
def sensitive():
    """Values whose sensitivity falls below 0, and their sensitivities."""
    rng = np.random.default_rng(0)
    values = rng.normal(0, 2, 20000)
    return values, np.exp(np.minimum(values, 0)) * rng.gamma(2, size=20000)


def test_a_curve_is_undone(sensitive):
    curve = fit(*sensitive, SETTINGS)
    values = np.linspace(-20, 20, 999)
    assert np.allclose(curve.values(curve.coded(values)), values, atol=1e-9)
    assert (np.diff(curve.coded(values)) > 0).all()
    assert Curve.of(curve.row()) == curve
    assert np.float32(curve.low) == curve.low
    assert np.float32(curve.width) == curve.width


def test_steps_widen_where_sensitivity_falls(sensitive):
    values, weights = sensitive
    curve = fit(values, weights, SETTINGS)
    rise = curve.rise(curve.coded(np.array([-3.0, -1.5, 1.0])))
    assert rise == pytest.approx(np.exp([1.5, 0.75, 0.0]), rel=0.35)  # 1 / sqrt(weight)
    along = weights * curve.rise(curve.coded(values)) ** 2
    low, high = (along[values < -1].mean(), along[values > 0].mean())
    assert low == pytest.approx(high, rel=0.4)


def test_few_gaussians_have_no_curves():
    values = {"log_scales": np.zeros((10, 3)), "logit_opacities": np.zeros((10, 1))}
    assert fit_all(values, values, SETTINGS) == {}
