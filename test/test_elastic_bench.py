"""The virtual bench against homogeneous solutions, and the study against the order of its error."""

import numpy as np
import pytest

from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.elastic import body as bodies
from cube_tensor_driver.elastic import paper
from cube_tensor_driver.elastic.bench import Bench, plates, rod
from cube_tensor_driver.elastic.body import Body
from cube_tensor_driver.elastic.study import study

BODY = Body()


def uniaxial(stretch, young, poisson):
    """Cauchy sigma_zz of the neo-Hookean body at this stretch along z, free along x, none along y."""
    mu, lam = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    low, high = 0.1, 10.0  # bisection for P_xx = 0, which grows with the stretch along x
    for _ in range(200):
        x = (low + high) / 2
        low, high = (low, x) if mu * (x - 1 / x) + lam * np.log(x * stretch) / x > 0 else (x, high)
    return (mu * (stretch - 1 / stretch) + lam * np.log(x * stretch) / stretch) / x


@pytest.mark.parametrize("finite", [False, True])
def test_sliding_plates_without_a_cube_press_evenly(finite):
    result = Bench(BODY, cube=False, finite=finite).run([plates(BODY, 2e-3, bonded=False)])
    strain = 2e-3 / BODY.height
    linear = -strain * BODY.young / (1 - BODY.poisson**2)
    exact = uniaxial(1 - strain, BODY.young, BODY.poisson) if finite else linear
    zz, *others = result.state[0]
    assert zz == pytest.approx(exact, rel=1e-6)
    assert np.abs(others).max() < 1e-6 * abs(exact)
    if not finite:
        assert result.pads[0] == pytest.approx([exact] * 4 + [0] * 4, abs=1e-6 * abs(exact))


def test_finite_strain_is_linear_for_small_loads():
    step = [rod(BODY, 1e-6, 1e-3)]
    linear, finite = (Bench(BODY, finite=kind).run(step).pads[0] for kind in (False, True))
    assert np.abs(linear - finite).max() < 2e-3 * np.abs(linear).max()
    assert np.abs(linear - finite).max() > 0


def test_shear_leaves_the_linear_normal_sum_alone_and_not_the_finite_one():
    steps = [plates(BODY, 1e-3), plates(BODY, 1e-3, 3e-3)]
    before, after = Bench(BODY).run(steps).pads[:, :4]
    assert after.sum() == pytest.approx(before.sum(), rel=1e-9)
    before, after = Bench(BODY, finite=True).run(steps).pads[:, :4]
    assert abs(after.sum() / before.sum() - 1) > 1e-3


def test_a_mirrored_rod_mirrors_the_pads():
    right, left = (Bench(BODY).run([rod(BODY, 1e-3, x)]).pads[0] for x in (2e-3, -2e-3))
    assert left == pytest.approx(right[[1, 0, 3, 2, 6, 7, 4, 5]], rel=1e-6)


def test_too_large_a_load_is_refused():
    with pytest.raises(ElasticError, match="press less"):
        Bench(BODY, finite=True).run([rod(BODY, 12e-3, 0.0)])


def test_prototype_signs():
    frequency = 100e3 + np.array([[-1.0, -3.0, -1.0, -1.0]])
    assert paper.prototype(frequency) == pytest.approx(np.array([[6.0, -2.0, 2.0]]))


def test_rod_sweep_splits_the_signal():
    table = paper.rod_sweep(places=(0.0, 2e-3))
    assert np.allclose(np.array(table["shear"]) + table["crosstalk"], table["signal"])
    assert abs(table["signal"][0]) < 1e-6 * abs(table["signal"][1])


def test_study_error_falls_with_the_square_of_the_side(monkeypatch):
    """The pads see the second derivative of the stress: the error of a stress goes as (d0 / depth)^2."""
    monkeypatch.setattr(bodies, "_SPACE_MESHES", ((1.0, 0.3, 6.0),) * 3)
    result = study(sides=(1e-3, 0.5e-3), widths=(5e-3,), offsets=(-8e-3, -2e-3, 2e-3, 8e-3))
    zz, slope = COMPONENTS.index("zz"), COMPONENTS.index("zz_x")
    for error in result.error.values():
        assert error[0, 0, zz] < 0.06 and error[0, 0, slope] < 0.06
    coarse, fine = result.error["cube"][:, 0, zz]
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.3)
    assert ("cube", 1e-3, "zz", 5e-3) in result.trusted()
    assert np.isnan(result.error["quad"][0, 0, COMPONENTS.index("yy")])


def test_study_refuses_a_cube_at_the_surface():
    with pytest.raises(ElasticError, match="leaves the skin"):
        study(sides=(6e-3,))
