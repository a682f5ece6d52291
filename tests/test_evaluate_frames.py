"""Which files are compared with which."""

import json
from pathlib import Path

import pytest

from torch_vdm.evaluate.frames import EvaluationError, match, natural, read_manifest


def touch(folder: Path, *names: str) -> None:
    """Make files of some content."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"content")


def test_frames_are_matched_by_their_path_without_the_suffix(tmp_path: Path) -> None:
    touch(tmp_path / "ref", "s/2.exr", "s/10.exr", "x.y.png", "note.txt", ".hidden/1.exr")
    touch(tmp_path / "a", "s/10.png", "s/2.png", "x.y.exr")
    found = match(str(tmp_path / "ref"), {"A": str(tmp_path / "a")}, tmp_path / "out")
    assert [job.frame for job in found.jobs] == ["s/2", "s/10", "x.y"]
    assert found.jobs[0].path == tmp_path / "a/s/2.png"
    assert found.missing == []


def test_what_has_no_partner_is_told(tmp_path: Path) -> None:
    touch(tmp_path / "ref", "1.exr", "2.exr", "3.exr", "3.png")
    touch(tmp_path / "a", "1.exr", "3.exr", "4.exr")
    found = match(str(tmp_path / "ref"), {"A": str(tmp_path / "a")}, tmp_path / "out")
    assert [job.frame for job in found.jobs] == ["1"]
    told = {missing.frame: missing.why for missing in found.missing}
    assert told["2"] == "missing in the test"
    assert told["4"] == "missing in the reference"
    assert "3.exr and 3.png" in told["3"]


def test_a_pattern_names_frames_by_its_wildcards(tmp_path: Path) -> None:
    touch(tmp_path, "hall/ref_512.exr", "hall/low_16.exr", "room/ref_512.exr", "room/low_16.exr")
    found = match(f"{tmp_path}/*/ref_*.exr", {"16": f"{tmp_path}/*/low_*.exr"}, tmp_path / "out")
    assert {missing.frame for missing in found.missing} == {
        "hall/512", "room/512", "hall/16", "room/16",
    }  # fmt: skip
    found = match(f"{tmp_path}/*/ref_512.exr", {"16": f"{tmp_path}/**/low_16.*"}, tmp_path / "o")
    assert [job.frame for job in found.jobs] == ["hall", "room"]


@pytest.mark.parametrize(
    ("pattern", "frame"),
    [
        ("*", "ab_0001"),
        ("ab_*", "0001"),
        ("[a]b_00?1.exr", "a-0"),
        ("**/*.exr", "ab_0001"),
        ("ab*.e?r", "_0001"),
    ],
)
def test_every_wildcard(tmp_path: Path, pattern: str, frame: str) -> None:
    touch(tmp_path, "ab_0001.exr")
    place = f"{tmp_path}/{pattern}"
    assert match(place, {"A": place}, tmp_path / "out").jobs[0].frame == frame


def test_results_in_a_folder_are_no_frames(tmp_path: Path) -> None:
    touch(tmp_path, "1.exr", "out/maps/A/1.exr")
    found = match(str(tmp_path), {"A": str(tmp_path)}, tmp_path / "out")
    assert [job.frame for job in found.jobs] == ["1"]


def test_numbered_frames_know_the_one_before(tmp_path: Path) -> None:
    touch(tmp_path, "v2_0009.exr", "v2_0010.exr", "v2_0012.exr", "still.exr")
    jobs = match(str(tmp_path), {"A": str(tmp_path)}, tmp_path / "out").jobs
    before = {job.frame: job.before for job in jobs}
    assert before["v2_0010"] == (tmp_path / "v2_0009.exr",) * 2
    assert before["v2_0009"] is before["v2_0012"] is before["still"] is None


@pytest.mark.parametrize("place", ["missing", "empty"])
def test_a_folder_without_images_is_refused(tmp_path: Path, place: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(EvaluationError, match="expected"):
        match(str(tmp_path / place), {"A": str(tmp_path)}, tmp_path / "out")


@pytest.mark.parametrize(
    ("place", "told"),
    [("1.exr", "name its folder"), ("out", "outside the output"), ("out/*", "outside the output")],
)
def test_a_file_and_the_output_are_no_folders_of_frames(
    tmp_path: Path, place: str, told: str
) -> None:
    touch(tmp_path, "1.exr", "out/maps/A/1.exr")
    with pytest.raises(EvaluationError, match=told):
        match(str(tmp_path / place), {"A": str(tmp_path)}, tmp_path / "out")


@pytest.mark.parametrize("test", ["..", "a/b", "", "a\nb", "C:x"])
def test_a_test_is_named_by_a_word(tmp_path: Path, test: str) -> None:
    touch(tmp_path, "1.exr")
    with pytest.raises(EvaluationError, match="expected a word"):
        match(str(tmp_path), {test: str(tmp_path)}, tmp_path / "out")


def test_a_name_that_no_file_may_have_is_skipped(tmp_path: Path) -> None:
    touch(tmp_path, "1.exr", "line\nfeed.exr", "back\\slash.exr")
    found = match(str(tmp_path), {"A": str(tmp_path)}, tmp_path / "out")
    assert [job.frame for job in found.jobs] == ["1"]
    assert {missing.frame for missing in found.missing} == {"line\\nfeed", "back\\slash"}


def test_a_manifest_says_it_itself(tmp_path: Path) -> None:
    lines = [
        {"frame": "b", "reference": "r/b.exr", "test": "two", "path": "/else/b.exr"},
        {"frame": "a", "reference": "r/a.exr", "test": "one", "path": "t/a.exr"},
    ]
    (tmp_path / "m.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n\n")
    rows = [
        "path,test,frame,reference,note",
        "/else/b.exr,two,b,r/b.exr,x",
        "t/a.exr,one,a,r/a.exr,",
    ]
    (tmp_path / "m.csv").write_text("\n".join(rows))
    found = read_manifest(tmp_path / "m.jsonl")
    assert found == read_manifest(tmp_path / "m.csv")
    assert found.tests == ["two", "one"]
    assert [(job.frame, job.test) for job in found.jobs] == [("a", "one"), ("b", "two")]
    assert found.jobs[0].reference == tmp_path / "r/a.exr"
    assert found.jobs[1].path == Path("/else/b.exr")


@pytest.mark.parametrize(
    ("frame", "test"),
    [
        ("../a", "A"), ("/a", "A"), ("a/../../b", "A"), ("a//b", "A"), ("a\\..\\b", "A"),
        ("a", ".."),
        ("a", "x/../y"), ("C:a", "A"), ("a" * 300, "A"), (".", "A"), ("a\x00b", "A"),
    ],
)  # fmt: skip
def test_a_manifest_cannot_write_elsewhere(tmp_path: Path, frame: str, test: str) -> None:
    line = {"frame": frame, "reference": "r.exr", "test": test, "path": "t.exr"}
    (tmp_path / "m.jsonl").write_text(json.dumps(line))
    with pytest.raises(EvaluationError, match=r"line 1: a (frame|test)'s name: expected") as told:
        read_manifest(tmp_path / "m.jsonl")
    assert str(told.value).isprintable()


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("m.csv", b"frame,reference,path\na,b,c\n", "no test"),
        ("m.csv", b"frame,reference,test,path\na,b\n", "no test and no path"),
        ("m.csv", b"frame,reference,test,path\na,b,c,d\na,b,c,d\n", "a of c again"),
        ("m.csv", b"", "none"),
        ("m.csv", b'frame,reference,test,path\n"a', "CSV or JSON lines"),
        ("m.csv", b"\xff\xfe\x00", "UTF-8"),
        ("m.jsonl", b"[1, 2]\n", "expected a JSON object"),
        ("m.jsonl", b"{\n", "expected a JSON object"),
        ("m.jsonl", b"[" * 100000, "expected a JSON object"),
        ("m.jsonl", b'{"frame": 1, "reference": "a", "test": "b", "path": "c"}', "no frame"),
    ],
)
def test_a_wrong_manifest_gets_one_line(
    tmp_path: Path, name: str, content: bytes, told: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(EvaluationError, match=told):
        read_manifest(tmp_path / name)


def test_a_missing_manifest_is_told(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="cannot be read"):
        read_manifest(tmp_path / "none.csv")


def test_numbers_in_names_count() -> None:
    assert sorted(["a10", "a9", "a", "b1", "9"], key=natural) == ["9", "a", "a9", "a10", "b1"]
