# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Encoding and decoding of messages: frequencies, stress, compensation, skin, touches, contacts.

ROS nodes and the code for bags (recordings) share this folder, so it imports neither ROS nor a
library for bags.
"""
