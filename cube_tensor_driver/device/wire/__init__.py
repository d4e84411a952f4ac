# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The wire protocol: conversion of bytes to frames and of frames to bytes, without any I/O."""
