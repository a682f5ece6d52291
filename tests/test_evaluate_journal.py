"""Results outlive a kill at any byte."""

from pathlib import Path

import pytest

from torch_vdm.evaluate import journal
from torch_vdm.evaluate.journal import NAME, Journal, Result
from torch_vdm.io import ImageError


def read(folder: Path) -> dict[tuple[str, str], Result]:
    """Return what a journal has."""
    with Journal(folder) as lines:
        return dict(lines)


def result(frame: str, value: float) -> Result:
    return Result(frame=frame, test="A", key="k", figures={"max_jnd": value}, notes=["<é>"])


def test_what_was_added_is_read(tmp_path: Path) -> None:
    with Journal(tmp_path) as lines:
        lines.add(result("1", 0.5))
        lines.add(result("2", 1.5))
    with Journal(tmp_path) as lines:
        lines.add(result("1", 2.5))
    known = read(tmp_path)
    assert list(known) == [("1", "A"), ("2", "A")]
    assert known["1", "A"].figures["max_jnd"] == 2.5
    assert known["2", "A"].notes == ["<é>"]


@pytest.mark.parametrize("block", [1, 7, 2**16])
def test_a_torn_line_costs_itself_alone(
    tmp_path: Path, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal, "BLOCK", block)
    whole = result("1", 0.5).line()
    for cut in (0, 1, 40, len(whole) - 1):
        (tmp_path / NAME).write_bytes(whole + result("2", 1.0).line()[:cut])
        assert list(read(tmp_path)) == [("1", "A")]
        with Journal(tmp_path) as lines:
            lines.add(result("3", 1.0))
        assert list(read(tmp_path)) == [("1", "A"), ("3", "A")]
    (tmp_path / NAME).write_bytes(whole[:10])
    with Journal(tmp_path):
        assert (tmp_path / NAME).read_bytes() == b""


def test_lines_of_another_version_count_for_nothing(tmp_path: Path) -> None:
    foreign = b'{"frame": "1", "test": "A", "other": 1}\n[]\nnull\n{"frame": "2"}\n\xff\n'
    (tmp_path / NAME).write_bytes(foreign + result("3", 1.0).line())
    assert list(read(tmp_path)) == [("3", "A")]


def test_no_journal_is_an_empty_one(tmp_path: Path) -> None:
    assert read(tmp_path) == {}


def test_two_at_once_are_refused(tmp_path: Path) -> None:
    with Journal(tmp_path) as lines:
        lines.add(result("1", 0.5))
        with pytest.raises(ImageError, match="no other evaluation at work there"):
            Journal(tmp_path)
        lines.add(result("2", 0.5))
    assert len(read(tmp_path)) == 2


def test_a_folder_that_takes_no_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(ImageError, match="cannot be written"):
        Journal(tmp_path / "file")
