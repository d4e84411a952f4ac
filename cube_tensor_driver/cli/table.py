# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The table of commands, which ./cube --help prints. Each command has a module of the same name."""

from __future__ import annotations

GROUPS = {
    "Run a skin": {
        "demo": "run simulated cubes, driver and reconstruction, with a live table",
        "view": "show a running skin in the browser: 3-D, plots, tare, recording",
        "param": "list, read or set the parameters of nodes that run",
        "ports": "list the serial ports, and which of them answer as hubs",
        "bringup": "look at the pads of a new hub, find swapped ones by presses, write a skin file",
        "check": "go through every rule of the wire protocol against a hub",
        "topics": "list the topics that are published, with types and rates",
        "echo": "print what comes on a topic: stress as lines with units, others as YAML",
        "tare": "take the present load of a running skin as no load, or clear that",
    },
    "Describe a skin": {
        "config": "write the skin file of a grid, or check a skin file",
        "urdf": "print the URDF of a skin: one link per cube under its parent frame",
    },
    "Record and evaluate": {
        "record": "record the topics of a running skin into a rosbag2 folder",
        "replay": "publish a bag; a reconstruction node makes the stress again",
        "bag": "show what a bag holds, or repair one",
        "plot": "draw frequencies, stress, gradient and residual of one cube",
        "reprocess": "compute stress from the recorded frequencies of bags again",
        "export": "make a LeRobot data set of bags, or Parquet, CSV or Zarr tables",
    },
    "Design and calibrate a cube": {
        "layout": "show what a layout's pads measure: ranks, unobservable modes",
        "fem": "compute a cube's response matrix by finite elements",
        "fit": "calibrate from a table of known loads and measured frequencies",
    },
    "Test faults and speed": {
        "inject": "inject a fault into running simulated hubs",
        "torture": "run and check 32 cubes at 500 Hz under a random mix of faults",
        "bench": "measure speed against the bare minimum",
    },
    "Study the sensor": {
        "study": "find how wide a contact must be for each layout to be right",
        "paper": "repeat the source paper's experiments on a virtual bench",
    },
    "Develop": {
        "firmware": "build, run or test the hubs in C",
        "test": "build and run the test suite",
        "lint": "check style and types (ruff, mypy)",
        "docs": "build the documentation as HTML",
        "pictures": "draw the pictures of the documentation again",
        "exec": "run any command inside the built environment",
    },
}
"""Heading of a group -> name of a command -> its line of help.

Groups and commands are in the order in which a user needs them.
"""

PACKAGES = {
    "fem": "cube_tensor_design",
    "study": "cube_tensor_design",
    "paper": "cube_tensor_design",
    "check": "cube_tensor_hub",
    "firmware": "cube_tensor_hub",
    "bench": "workshop",
    "torture": "workshop",
    "pictures": "workshop",
    "test": "workshop",
    "lint": "workshop",
    "docs": "workshop",
}
"""Name of a command -> Python package that contains its module, for commands outside the driver."""

COMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}
"""Name of a command -> its description, without the groups."""
