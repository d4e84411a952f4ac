# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""python -m rclpy_without FEATURE MODULE [ARGUMENT ...]: runs a module where rclpy lacks a feature.

What is taken away is what Humble lacks, which does not exist as wheels.
"""

from __future__ import annotations

import importlib
import runpy
import sys
import types


def no_events_executor() -> None:
    sys.modules["rclpy.experimental.events_executor"] = None


def no_event_handler() -> None:
    """Its names are in another module in Humble."""
    events = importlib.import_module("rclpy.event_handler")
    older = types.ModuleType("rclpy.qos_event")
    older.SubscriptionEventCallbacks = events.SubscriptionEventCallbacks
    sys.modules["rclpy.qos_event"] = older
    sys.modules["rclpy.event_handler"] = None


def no_message_numbers() -> None:
    """The last one: it imports what looks for the others. rclpy itself needs the name."""
    from cube_tensor_driver.ros import compat

    compat.Subscription = type("Subscription", (), {})


FEATURES = {
    remove.__name__: remove
    for remove in (
        no_events_executor,
        no_event_handler,
        no_message_numbers,
    )
}

if __name__ == "__main__":
    _, names, module, *arguments = sys.argv
    importlib.import_module("rclpy.lifecycle")  # rclpy itself keeps what it has imported
    for name in names.split(","):
        FEATURES[name]()
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__")
