"""What the page shows of the node `contacts`: its contacts, and its field on more points."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser: pip install viser")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")


from cube_tensor_driver.browser import clients
from cube_tensor_driver.browser.clients import ContactsClient
from cube_tensor_driver.browser.colouring import Colouring
from cube_tensor_driver.browser.moment import DEVIATION, Moment, SurfaceField
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.messages.contacts import contacts_message, decode_traction, traction_message
from cube_tensor_driver.ros.messages import make_message
from cube_tensor_driver.touch.surface import Contact, Surface, patches
from cube_tensor_driver.views.scene import QUANTITIES

DEPTH, PITCH = 0.004, 0.01


class Node:
    """Keeps the callbacks of a node, by topic, and wraps none."""

    def __init__(self) -> None:
        self.callbacks = {}

    def create_subscription(self, kind, topic, callback, depth) -> None:
        self.callbacks[topic] = callback

    def catch(self, callback):
        return callback


@pytest.fixture
def poses() -> CubePoses:
    x, y = np.meshgrid(PITCH * np.arange(4), PITCH * np.arange(4))
    place = np.stack([x.ravel(), y.ravel(), np.zeros(16)], axis=1)
    return CubePoses(place, np.tile(np.eye(3), (16, 1, 1)), np.full(16, 0.002))


def cloud_of(poses: CubePoses) -> np.ndarray:
    """As the node publishes it: 2 x 2 points on the surface above each cube."""
    points = patches(poses, PITCH / 2, 2).reshape(-1, 3) + np.array([0, 0, DEPTH])
    pressure = 1e3 + 1e5 * points[:, 0] - 2e5 * points[:, 1]
    return np.column_stack([points, pressure, 0.3 * pressure, 70.0 + 0.01 * pressure])


def test_field_and_contacts_of_the_node_are_shown_until_they_are_old(poses, monkeypatch):
    node = Node()
    client = ContactsClient(node, node)
    surface = Surface(poses, DEPTH)
    assert client.found(surface) == (None, None)
    cloud = np.vstack([np.full(6, np.nan), cloud_of(poses)])
    contact = Contact(np.ones(3), np.array([0, 0, 1.0]), np.arange(3.0), 2.0, 0.5, 1e-5, 1e-4, 0.1)
    node.callbacks["contacts"](contacts_message(make_message, 5, "skin_base", [contact]))
    node.callbacks["traction"](traction_message(make_message, 5, "skin_base", cloud))
    (shown,), field = client.found(surface)
    for name, value in contact._asdict().items():
        np.testing.assert_array_equal(getattr(shown, name), value)
    # The points lie a quarter of the way between those of the cloud. The weights 9 : 1.8 : 1.8 : 1
    # of the inverse squares give 0.206 of the step instead: 0.044 of 500 + 1000 Pa too few.
    x, y, _ = surface.points.T
    inside = (x > 0) & (x < 3 * PITCH) & (y > 0) & (y < 3 * PITCH)
    true = 1e3 + 1e5 * x - 2e5 * y
    assert np.abs(field.pressure - true)[inside].max() < 0.05 * 1500
    np.testing.assert_allclose(field.shear, 0.3 * field.pressure, rtol=1e-5)
    np.testing.assert_allclose(field.sigma, 70.0 + 0.01 * field.pressure, rtol=1e-5)
    monkeypatch.setattr(clients, "MAX_CONTACTS_AGE_S", -1.0)
    assert client.found(surface) == (None, None)


@pytest.mark.parametrize("known", [True, False])
def test_the_deviation_is_a_colour_while_the_node_says_it(poses, known):
    """On the surface and on the cubes below it; grey where it is unknown."""
    surface = Surface(poses, DEPTH)
    pressure = np.linspace(0.0, 9e3, len(surface.points))
    sigma = 100.0 + 0.1 * pressure
    sigma[surface.middle[3]] = np.nan
    field = SurfaceField(pressure, 0 * pressure, sigma if known else None)
    values = np.full((16, 15), 5.0)
    moment = Moment(values, np.zeros(16), np.zeros(16, int), np.zeros(16, int), field, [])
    colouring = Colouring.of(moment, surface, DEVIATION, 0.0, 0.0)
    if not known:
        assert np.isnan(colouring.field).all() and np.isnan(colouring.cubes).all()
        assert colouring.text(2) == "unknown"
        return
    np.testing.assert_array_equal(colouring.field, sigma)
    np.testing.assert_array_equal(colouring.cubes, sigma[surface.middle])
    assert colouring.top == np.nanmax(sigma)
    at = surface.middle[2]
    near = np.linalg.norm(surface.points - poses.position[2], axis=1)
    assert near[at] == near.min()
    said = f"{pressure[at] / 1e3:.2f} ± {sigma[at] / 1e3:.2f} kPa"
    assert colouring.text(2) == f"pressure on the surface {said}"
    assert colouring.text(3).endswith("± unknown kPa")
    by_pressure = Colouring.of(moment, surface, QUANTITIES["pressure"], 0.0, 0.0)
    assert by_pressure.text(2).endswith(f"on the surface {said}")


def test_another_point_cloud_is_refused_in_words(poses):
    message = traction_message(make_message, 5, "skin_base", cloud_of(poses))
    message.fields = message.fields[:3]
    with pytest.raises(BagError, match="has the fields x, y, z; those of the topic traction are"):
        decode_traction(message)
