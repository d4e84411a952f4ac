# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Driver and reconstruction with a hub that a test plays. All tests share both nodes; each plugs in
a hub of its own."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
import pytest

from cube_tensor_driver.device.wire import cobs

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from diagnostic_msgs.msg import DiagnosticArray
from played_hub import CUBE_UID, REST, SINGLE, PlayedHub, greeting, sample

from conftest import free_domain, observer_node
from cube_tensor_driver.device.wire.protocol import Command
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes


class Nodes:
    """Both nodes in processes of their own, and what they say since the last hub was plugged in."""

    def __init__(self, ros, folder, children):
        self._ros, self._ports, self.children = ros, folder / "ports", children
        self.node, self.wait = ros.node, ros.wait
        self.frequencies = ros.listen(SkinFrequencies, "frequencies")
        self.stress = ros.listen(SkinStress, "stress")
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.hub = None
        for process in list_skin_processes(SINGLE, simulated=SimulatedHubs(self._ports))[1:]:
            children.start(process)
        self.wait(
            lambda: (
                self.node.count_publishers("stress") and self.node.count_subscribers("frequencies")
            )
        )

    def plug(self, hello: bytes) -> PlayedHub:
        """A hub that says hello when it is asked, and was then told to start."""
        self.hub = PlayedHub(self._ports, "hub0")
        self.wait(lambda: self.hub.asked(Command.HELLO))
        for kept in (self.frequencies, self.stress, self.diagnostics):
            kept.clear()
        self.hub.send(hello)
        return self.hub

    def unplug(self):
        """The driver has noticed when it says that the link waits."""
        said = self.children.log("driver").count("hub0: waiting")
        self.hub.close()
        self.wait(lambda: self.children.log("driver").count("hub0: waiting") > said)

    def send_until(self, arrived, millihertz=REST):
        """Samples with these values until something came of them."""
        numbers = itertools.count()

        def step():
            self.hub.send(sample(next(numbers), millihertz))
            return arrived()

        self.wait(step)

    def link(self) -> dict[str, str]:
        """The newest diagnostics of the link: its values, and its message as ''."""
        for array in reversed(self.diagnostics):
            for status in array.status:
                if status.name == "/driver: link hub0":
                    return {pair.key: pair.value for pair in status.values} | {"": status.message}
        return {}

    def says(self, text: str) -> bool:
        return text in self.link().get("", "")


@pytest.fixture(scope="module")
def both_nodes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nodes")
    with free_domain() as domain, observer_node(domain) as ros, Children(folder) as children:
        yield Nodes(ros, folder, children)


@pytest.fixture
def nodes(both_nodes):
    yield both_nodes
    both_nodes.unplug()
    both_nodes.children.check()


def test_damaged_bytes_are_counted_and_the_next_good_frame_arrives(nodes):
    def sequences():
        return [number for message in nodes.frequencies for number in message.sequence]

    def counted():
        return {name: int(nodes.link()[name]) for name in ("crc", "framing", "length")}

    hub = nodes.plug(greeting())
    nodes.wait(lambda: hub.asked(Command.START))
    nodes.wait(nodes.link)
    before = counted()
    nodes.send_until(lambda: nodes.frequencies)
    flipped = bytearray(sample(1001, REST))
    flipped[20] ^= 0x10
    garbage = b"\x07garbage\x00\xff\xff"
    cut_short = sample(1003, REST)[:-9]
    for data in (bytes(flipped), garbage, sample(1002, REST), cut_short, sample(1004, REST)):
        hub.send(data)
    nodes.wait(lambda: 1004 in sequences())
    assert [number for number in sequences() if number > 1000] == [1002, 1004]
    nodes.wait(lambda: counted()["crc"] > before["crc"])
    # The flipped frame; the garbage, the run before the next zero, and the frame cut short.
    assert sum(counted().values()) - sum(before.values()) == 4


def test_a_hub_with_more_cubes_than_the_skin_gives_those_it_has(nodes):
    hub = nodes.plug(greeting(cube_uids=(CUBE_UID, CUBE_UID, 0xEF)))
    nodes.wait(lambda: hub.asked(Command.START))
    nodes.send_until(lambda: nodes.frequencies, np.repeat(REST, 3, axis=0))
    nodes.wait(lambda: nodes.link().get(""))
    text = nodes.link()[""]
    assert "cube 1 (uid 0xcd) left out: an earlier one has the same uid" in text
    assert "cube 2 (uid 0xef) not in the skin file: add it there" in text
    assert all(set(message.cube) == {0} for message in nodes.frequencies)


def test_another_protocol_version_is_an_error_that_names_both(nodes):
    body = bytes([3, 2, 5, 0]) + bytes(5)  # a sound STATS frame of version 2
    nodes.plug(b"\0" + cobs.encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0")
    words = "protocol version 2, this driver version 1"
    nodes.wait(lambda: nodes.says(words))
    nodes.wait(lambda: words in nodes.children.log("driver"))
