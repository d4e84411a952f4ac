# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The programs of docs/learning.md for many recordings run, on each engine that is installed."""

from __future__ import annotations

import pyarrow
import pyarrow.dataset
import pyarrow.parquet
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")
pytest.importorskip("fsspec", reason="needs fsspec: pip install fsspec")

from bag_maker import make_bag
from test_python_page import blocks

import cube_tensor_driver as ctd
from conftest import ROOT
from cube_tensor_driver.bags.reprocess.job import ReprocessJob, reprocess

PAGE = ROOT / "docs" / "learning.md"
BAGS = ("run1", "run2")
PARTITION = "robot=arm1/skin=skin/day=2023-11-14"
"""Folder of the bags' stress: the stamps of `make_bag` begin on that day (UTC)."""


def program(word: str) -> str:
    """The block of the page that contains a word."""
    [found] = [block for block in blocks(PAGE, "python") if word in block]
    return found


@pytest.fixture
def page(tmp_path, monkeypatch) -> dict:
    """The names that the page's first program defines, in a folder with two bags."""
    monkeypatch.chdir(tmp_path)
    for name in BAGS:
        make_bag(tmp_path / name, ROOT / "config" / "skin_demo.yaml", 20, tare=(10, 1.001))
    there: dict = {"__name__": "page"}
    exec(compile(program("def write_stress"), PAGE, "exec"), there)
    return there


def assert_reprocessed(folder) -> None:
    """Every bag has a file in the partition with the bytes of `./cube reprocess`."""
    for name in BAGS:
        reprocess(ReprocessJob(folder / name, folder / f"{name}.parquet", "parquet"))
        expected = pyarrow.parquet.read_table(folder / f"{name}.parquet", partitioning=None)
        found = pyarrow.parquet.read_table(folder / "stress" / PARTITION / f"{name}.parquet")
        assert found.column_names == expected.column_names
        for column in set(expected.column_names) - {"cube"}:
            one, other = (table[column].to_numpy().tobytes() for table in (found, expected))
            assert one == other, column
        assert found["cube"].to_pylist() == expected["cube"].to_pylist()


def test_program_goes_on_where_it_was_interrupted(page, tmp_path, monkeypatch):
    """A bag whose file is complete is skipped, and half a file is never taken for a whole one."""
    assert page["write_stress"](BAGS[0]) == {"rows": 320}

    def fail(table, file, **options):
        file.write(b"PAR1")
        raise KeyboardInterrupt

    with monkeypatch.context() as interrupted, pytest.raises(KeyboardInterrupt):
        interrupted.setattr(pyarrow.parquet, "write_table", fail)
        page["write_stress"](BAGS[1])
    assert [path.stem for path in (tmp_path / "stress").rglob("*.parquet")] == [BAGS[0]]
    assert [page["write_stress"](name)["rows"] for name in BAGS] == [0, 320]
    assert_reprocessed(tmp_path)


def test_program_runs_on_dask(page, tmp_path):
    pytest.importorskip("distributed", reason="needs distributed: pip install distributed")
    exec(program("dask.distributed"), page)
    assert_reprocessed(tmp_path)


def test_program_runs_on_ray(page, tmp_path, monkeypatch):
    ray = pytest.importorskip("ray", reason="needs ray: pip install 'ray[data]'")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    ray.init(num_cpus=2, include_dashboard=False)
    try:
        exec(program("import ray"), page)
        assert_reprocessed(tmp_path)
        tables = []
        for name in BAGS:
            with ctd.open_bag(name) as source:
                tables.append(ctd.read_frequency_table(source))
        blocks_of_bags = ray.data.from_arrow(tables).map_batches(
            ctd.reprocess_table,
            batch_size=None,
            batch_format="pyarrow",
            fn_kwargs={"skin": source.skin},
        )
        zz = pyarrow.dataset.dataset("run1.parquet").to_table()["stress_zz_Pa"].to_pylist()
        assert [row["stress_zz_Pa"] for row in blocks_of_bags.take_all()] == zz + zz
    finally:
        ray.shutdown()


def test_query_of_the_page_finds_the_lowest_stress_of_each_cube(page, tmp_path, capsys):
    pytest.importorskip("duckdb", reason="needs duckdb: pip install duckdb")
    for name in BAGS:
        page["write_stress"](name)
    assert_reprocessed(tmp_path)
    exec(program("import duckdb"), page)
    found = page["duckdb"].sql(page["query"]).fetchall()
    assert "arm1" in capsys.readouterr().out
    table = pyarrow.dataset.dataset("run1.parquet").to_table()
    lowest = table.group_by("cube").aggregate([("stress_zz_Pa", "min")]).to_pylist()
    expected = [("arm1", row["cube"], row["stress_zz_Pa_min"]) for row in lowest]
    assert sorted(found) == sorted(expected)


def test_program_writes_to_an_object_store(page, monkeypatch):
    server = pytest.importorskip("moto.server", reason="needs moto: pip install 'moto[server]'")
    s3fs = pytest.importorskip("s3fs", reason="needs s3fs: pip install s3fs")
    store = server.ThreadedMotoServer("127.0.0.1", port=0)
    store.start()
    try:
        host, port = store.get_host_and_port()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "test")
        files = s3fs.S3FileSystem()
        files.mkdir("fleet")
        for name in BAGS:
            assert page["write_stress"](name, folder="s3://fleet/stress") == {"rows": 320}
        found = sorted(files.find("fleet/stress"))
        assert found == [f"fleet/stress/{PARTITION}/{name}.parquet" for name in BAGS]
        data = pyarrow.dataset.dataset("fleet/stress", filesystem=files, partitioning="hive")
        assert data.to_table(filter=pyarrow.dataset.field("robot") == "arm1").num_rows == 640
    finally:
        store.stop()
