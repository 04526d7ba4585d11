"""The queue of what waits for a receiver: order, bound, restart, faults of the disk."""

from __future__ import annotations

from pathlib import Path

from servo_daemon.disk_queue import DiskQueue


def entries(first: int, last: int, size: int = 1000) -> list[tuple[str, str, bytes]]:
    return [("state", "axis1", f"{k}".encode().ljust(size)) for k in range(first, last)]


def bodies(queue: DiskQueue) -> list[int]:
    return [int(item.body) for item in queue.head(1000)]


def test_it_keeps_order_and_what_is_not_removed_over_a_restart(tmp_path: Path) -> None:
    queue = DiskQueue(tmp_path / "q.sqlite", 1e6)
    queue.put(entries(0, 5))
    queue.remove(queue.head(2)[-1].number)
    again = DiskQueue(tmp_path / "q.sqlite", 1e6)
    again.put(entries(5, 7))
    assert (bodies(again), len(again), again.dropped) == (
        [2, 3, 4, 5, 6],
        5,
        0,
    )  # the first was not closed, as after a kill
    again.close()
    queue.close()


def test_when_full_the_oldest_go_and_are_counted(tmp_path: Path) -> None:
    queue = DiskQueue(tmp_path / "q.sqlite", 100_000.0)
    for first in range(0, 500, 25):
        queue.put(entries(first, first + 25))
    kept = bodies(queue)
    assert kept == list(range(500 - len(kept), 500))
    assert 85 <= len(kept) <= 94  # 94 rows of 1064 bytes are 100 kB
    assert (queue.dropped, len(queue)) == (500 - len(kept), len(kept))
    queue.close()
    assert (tmp_path / "q.sqlite").stat().st_size < 300_000


def test_a_broken_file_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "q.sqlite"
    path.write_bytes(b"no database" * 1000)
    queue = DiskQueue(path, 1e6)
    queue.put(entries(0, 2))
    assert (bodies(queue), queue.problem) == ([0, 1], None)
    assert path.with_name("q.sqlite.bad").read_bytes().startswith(b"no database")
    queue.close()


def test_what_cannot_be_written_is_counted_and_told_and_it_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.write_text("a file where a folder should be")
    queue = DiskQueue(folder / "q.sqlite", 1e6)
    queue.put(entries(0, 3))
    assert (queue.dropped, len(queue), queue.head(10)) == (3, 0, [])
    assert "q.sqlite" in str(queue.problem)
    folder.unlink()
    queue.put(entries(3, 5))
    assert (bodies(queue), queue.dropped, queue.problem) == ([3, 4], 3, None)
    queue.close()


def test_without_a_file_it_is_in_memory() -> None:
    queue = DiskQueue(None, 1e6)
    queue.put(entries(0, 3))
    assert bodies(queue) == [0, 1, 2]
    queue.close()
