"""The node `contacts`: from `stress`, where something presses on the skin and how hard."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

from cube_tensor_driver.msg import SkinContacts

from ..core.errors import CubeError
from ..core.modes import COMPONENTS
from ..elastic.inverse import FieldDeviation, SurfaceInverse, TractionField
from ..elastic.layer import Layer
from ..elastic.surface import Contact, Surface
from ..elastic.touches import Touches, TrackedContact
from .messages import to_time
from .node import run
from .parameters import CONTACT_METHODS, CONTACTS
from .skin_subscriber import FollowedSkin, SkinSubscriberNode

INTERPOLATION, INVERSE = CONTACT_METHODS
FIELDS = ("x", "y", "z", "pressure", "shear", "sigma")
"""Of the points of `traction`, each a float32: m in the skin's parent frame, Pa on the surface, and
the standard deviation of the pressure, Pa."""


class Contacts(SkinSubscriberNode):
    """Publishes `contacts` for the newest `stress`, at most `rate` times a second.

    The arrays of a message are empty where nothing presses. The method `inverse` publishes the
    surface's `traction`, too. It is set up beside the node's thread: nothing is published before.
    """

    def __init__(self) -> None:
        super().__init__("contacts", CONTACTS, SkinContacts, 10)
        self._worker = ThreadPoolExecutor(1)

    def configure(self) -> None:
        self._traction = None
        if self.value("method") == INVERSE:
            self._traction = self.create_lifecycle_publisher(PointCloud2, "traction", 2)
            self._configured.callback(self.destroy_publisher, self._traction)
        super().configure()

    def is_wanted(self, publisher: Any) -> bool:
        listened = self._traction is not None and self._traction.get_subscription_count() > 0
        return listened or super().is_wanted(publisher)

    def set_up(self, skin: FollowedSkin) -> None:
        self._seen = 0
        self._failed = False
        if self.value("method") == INTERPOLATION:
            self._surface = Surface(skin.poses, self.value("depth"))
            return
        thickness = self.value("thickness") or np.inf
        layer, depth = Layer(thickness, self.value("poisson")), self.value("depth")
        layer.check_depth(depth)
        poses, noise = skin.poses, cubes_noise(skin.info)
        self._inverse: Future[SurfaceInverse] = self._worker.submit(
            SurfaceInverse.of_cubes, poses, noise, layer, depth
        )
        self._touches: Touches | None = None

    def message(self, skin: FollowedSkin, health: np.ndarray) -> SkinContacts | None:
        if skin.messages == self._seen:
            return None
        values = skin.newest.believed(health)
        if self._traction is None:
            message = contacts_message(self._surface.contacts(values, self.value("least")))
        else:
            touches = self._ready()
            if touches is None:
                return None
            message = tracked_message(touches.update(values))
        self._seen = skin.messages
        message.header.stamp = to_time(skin.stamp_ns)
        message.header.frame_id = skin.info.header.frame_id
        if self._traction is not None and self._traction.get_subscription_count():
            self._publish_traction(message.header, values)
        return message

    def _ready(self) -> Touches | None:
        """None while the inverse is being set up, or if it could not be: that is logged once."""
        if self._touches is None and self._inverse.done() and not self._failed:
            try:
                self._touches = Touches(self._inverse.result(), self.value("least"))
            except CubeError as error:
                self._failed = True
                self.get_logger().error(str(error))
        return self._touches

    def _publish_traction(self, header: Any, values: NDArray[np.float64]) -> None:
        touches = self._touches
        if touches is None or touches.field is None or self._traction is None:
            return
        inverse = self._inverse.result()
        self._traction.publish(
            traction_message(header, inverse.points, touches.field, inverse.deviation(values))
        )


def cubes_noise(info: Any) -> NDArray[np.float64]:
    """(cubes, 15, 15) covariance of the components of each cube of an `info`."""
    n = len(COMPONENTS)
    by_id = dict(zip(info.calibration_ids, np.reshape(info.covariance, (-1, n, n)), strict=True))
    return np.array([by_id[cube.calibration_id] for cube in info.cubes])


def contacts_message(contacts: list[Contact]) -> SkinContacts:
    """The message of interpolated contacts, without its header."""
    return SkinContacts(**_columns(contacts))


def tracked_message(contacts: list[TrackedContact]) -> SkinContacts:
    """The message of the inverse's contacts, without its header."""
    names = ("id", "moment", "shear_uncertainty", "area_uncertainty", "moment_uncertainty")
    more = {name: [getattr(contact, name) for contact in contacts] for name in names}
    return SkinContacts(**_columns(contacts), **more)


def _columns(contacts: list[Contact] | list[TrackedContact]) -> dict[str, list[Any]]:
    """What contacts of both methods have."""
    numbers = (
        "normal_force",
        "shear_force",
        "area",
        "position_uncertainty",
        "force_uncertainty",
    )
    columns: dict[str, list[Any]] = {
        name: [getattr(contact, name) for contact in contacts] for name in numbers
    }
    columns["position"] = [Point(**_xyz(contact.position)) for contact in contacts]
    columns["normal"] = [Vector3(**_xyz(contact.normal)) for contact in contacts]
    columns["force"] = [Vector3(**_xyz(contact.force)) for contact in contacts]
    return columns


def traction_message(
    header: Any,
    points: NDArray[np.float64],
    field: TractionField,
    deviation: FieldDeviation,
) -> PointCloud2:
    """The field as a cloud of points (M, 3) m with FIELDS."""
    shear = np.hypot(field.traction[:, 0], field.traction[:, 1])
    columns = [points, field.pressure[:, None], shear[:, None], deviation.pressure[:, None]]
    data = np.concatenate(columns, axis=1).astype("<f4")
    fields = [
        PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
        for k, name in enumerate(FIELDS)
    ]
    step = 4 * len(FIELDS)
    return PointCloud2(
        header=header,
        height=1,
        width=len(data),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(data),
        data=data.tobytes(),
        is_dense=True,
    )


def _xyz(vector: NDArray[np.floating]) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def main() -> None:
    run(lambda: [Contacts()])


if __name__ == "__main__":
    main()
