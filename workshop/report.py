# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Output of the figures of benchmarks and torture."""

from __future__ import annotations

from pathlib import Path

from cube_tensor_driver.config.output_files import to_json, write_json


def report(result: dict[str, object], json_path: Path | None) -> None:
    """Print results as JSON, and write them to a file as well if there is a path.

    Args:
        result: Names and values of the results.
        json_path: Path of the file; None: no file is written.
    """
    print(to_json(result, indent=2))
    if json_path is not None:
        write_json(json_path, result)
