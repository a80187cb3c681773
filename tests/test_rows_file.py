"""Rows of numbers in CSV files: what is read is what is there, and every mistake is told with its line."""

import io
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pk_jax.files.atomic import atomic_file, output_file
from pk_jax.files.columns import Column
from pk_jax.files.rows_file import LONGEST, format_rows, open_rows

LENGTHS = tuple(Column(f"l{i}", "length") for i in (1, 2, 3))
MIXED = (Column("x", "length"), Column("w", "number"), Column("phi", "angle"), Column("v", "number"))


@pytest.fixture
def read(tmp_path):
    def read(content, layouts=(LENGTHS,), unit="mm", columns=None, chunk=100):
        path = tmp_path / "rows.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with open_rows(str(path), layouts, unit=unit, columns=columns, chunk=chunk) as reader:
            return np.concatenate(list(reader))

    return read


GOOD = {
    "plain": "1,2,3\n4,5,6\n",
    "no newline at the end": "1,2,3\n4,5,6",
    "header": "l1,l2,l3\n1,2,3\n4,5,6\n",
    "units": "l1_mm,l2,l3_mm\n1,2,3\n4,5,6\n",
    "another order": "l3,l1,l2\n3,1,2\n6,4,5\n",
    "others": "t,l1,l2,what,l3\n0,1,2,a_b,3\n,4,5,ö,6\n",
    "empty lines": "\n\n1,2,3\n   \n4,5,6\n\n",
    "comments": "# a, b\nl1,l2,l3\n  # x,y,z\n1,2,3\n#\n4,5,6\n# 1,2\n",
    "crlf": "l1,l2,l3\r\n1,2,3\r\n\r\n4,5,6\r\n",
    "bom": "\ufeffl1,l2,l3\n1,2,3\n4,5,6\n",
    "bom, no header": "\ufeff1,2,3\n4,5,6\n",
    "spaces": " l1 , l2,l3\n 1, 2 ,3\n4,5,6  \n",
    "quotes": '"l1","l2",what,l3\n"1",2,"a, ""b""",3\n4, "5",c,6\n',
    "signs": "+1,2.,3e0\n.4E+1,5,60e-1\n",
}


@pytest.mark.parametrize("chunk", [1, 2, 3, 100])
@pytest.mark.parametrize("content", GOOD.values(), ids=GOOD)
def test_what_is_there_is_read(read, content, chunk):
    np.testing.assert_array_equal(read(content, chunk=chunk), [[1, 2, 3], [4, 5, 6]])


def test_nan_and_infinity_are_numbers(read):
    expected = [[np.nan, np.inf, -np.inf], [1, np.inf, 0]]
    np.testing.assert_array_equal(read("nan,inf,-Infinity\n1,1e999,-0\n"), expected)


@pytest.mark.parametrize(
    ("columns", "content"),
    [
        ("a,b,c", "c,b,t,a\n3,2,0,1\n6,5,0,4\n"),
        ("3,1,2", "2,3,1\n5,6,4\n"),  # never the names of a row of numbers
        ("2,3,5", "12:30,1,2,x,3\n12:31,4,5,y,6\n"),
        ("4,2,1", "c,b,t,a\n3,2,0,1\n6,5,0,4\n"),
        ("1,b,3", "a,b,b_in\n1,2,3\n4,5,6\n"),  # by number also what says another unit
    ],
)
def test_chosen_columns(read, columns, content):
    np.testing.assert_array_equal(read(content, columns=columns), [[1, 2, 3], [4, 5, 6]])


def test_the_first_layout_that_fits(read):
    shorter = MIXED[:2]
    assert read("x,w,phi,v\n1,2,3,4\n", (MIXED, shorter)).shape == (1, 4)
    assert read("x,w,phi\n1,2,3\n", (MIXED, shorter)).shape == (1, 2)
    assert read("1,2\n", (MIXED, shorter)).shape == (1, 2)
    np.testing.assert_array_equal(read("phi_rad,v,w,x_mm\n1,2,3,4\n", (MIXED,)), [[4, 3, 1, 2]])


BAD = {
    "empty": ("", "no rows"),
    "only a header": ("l1,l2,l3\n\n# 1,2,3\n", "no rows"),
    "only comments": ("# 1,2,3\n", "no rows"),
    "short row": ("1,2,3\n\n4,5\n", ":3: 2 fields where the first line has 3: '4,5'"),
    "long row": ("1,2,3\n4,5,6,7\n", ":2: 4 fields"),
    "two wrong rows that make up for each other": ("1,2,3\n4,5\n6,7,8,9\n", ":2: 2 fields"),
    "short row below a header": ("t,l1,l2,l3\n1,2,3\n", ":2: 3 fields where the first line has 4"),
    "a word": ("l1,l2,l3\n1,2,3\n4,five,6\n", ":3: field 2 (l2) must be a number, got 'five'"),
    "a word in the first row": ("1,2,x\n4,5,6\n", ":1: field 3 must be a number, got 'x'"),
    "nothing": ("1,2,3\n4,,6\n", ":2: field 2 (l2) must be a number, got ''"),
    "comma at the end": ("1,2,3,\n", ":1: field 4 must be a number, got ''"),
    "underscore": ("1,2,3\n4,5_0,6\n", ":2: field 2 (l2) must be a number, got '5_0'"),
    "other digits": ("1,2,3\n4,٥,6\n", ":2: field 2 (l2) must be a number, got '٥'"),
    "hexadecimal": ("1,2,3\n4,0x5,6\n", ":2: field 2"),
    "fortran": ("1,2,3\n4,5d0,6\n", ":2: field 2"),
    "too few columns": ("1,2\n", ":1: there must be 3 (l1,l2,l3) columns, got 2"),
    "too many columns": ("1,2,3,4\n", ":1: there must be 3 (l1,l2,l3) columns, got 4"),
    "semicolons": ("1;2;3\n4;5;6\n", ":1: no columns l1,l2,l3 among '1;2;3'"),
    "a name too few": ("l1,l2,q3\n1,2,3\n", ":1: no columns l1,l2,l3 among 'l1,l2,q3'; see --columns"),
    "other unit": (
        "l1_mm,l2_cm,l3\n1,2,3\n",
        ":1: column 'l2_cm' is in cm, but what is read are lengths in mm",
    ),
    "an angle": (
        "l1,l2_deg,l3\n1,2,3\n",
        ":1: column 'l2_deg' is in deg, but what is read are lengths in mm",
    ),
    "twice": ("l1,l2,l2_mm,l3\n1,2,3,4\n", ":1: 'l2' and 'l2_mm' are both l2"),
    "open quote": ('1,2,3\n4,"5,6\n7,8,9\n', ":2: unexpected end of data"),
    "latin-1": (b"1,2,3,\n" + "4,5,6,ä".encode("latin-1"), ":1: field 4"),
    "latin-1, unused": (b"l1,l2,l3,t\n" + "4,5,6,ä".encode("latin-1"), ":2: must be UTF-8"),
    "utf-16": ("1,2,3\n".encode("utf-16"), ":1: must be UTF-8"),
    "binary": (bytes(100), ":1: no columns"),
    "old line ends": ("1,2,3\n4,5,6\r7,8,9\n", ":2: new-line character"),
    "old line ends, unused": ("t,l1,l2,l3\na\rb,4,5,6\n", ":2: new-line character"),
    "endless line": (b"1,2,3\n" + b"1" * (LONGEST + 9) + b",2,3\n", ":2: a line must have at most"),
}


def test_a_line_may_have_a_mebibyte(read):
    line = "1,2,3" + ",0" * (2**19 - 3) + "\n"
    assert len(line) == 2**20
    np.testing.assert_array_equal(read(line, columns="1,2,3"), [[1, 2, 3]])


@pytest.mark.parametrize("chunk", [1, 100])
@pytest.mark.parametrize(("content", "expected"), BAD.values(), ids=BAD)
def test_what_is_wrong_is_told_with_its_line(read, content, expected, chunk):
    with pytest.raises(ValueError) as told:
        read(content, chunk=chunk)
    assert expected in str(told.value)
    assert "rows.csv" in str(told.value) and "\n" not in str(told.value) and len(str(told.value)) < 400


@pytest.mark.parametrize(
    ("columns", "content", "expected"),
    [
        ("a,b", "a,b,c\n1,2,3\n", "--columns: there must be 3 (l1,l2,l3) columns, got 2"),
        ("a,b,d", "a,b,c\n1,2,3\n", "--columns: no column 'd' among 'a,b,c'"),
        ("a,b,a", "a,b,c\n1,2,3\n", "must not name a column twice"),
        ("a,b,c", "a,b,c,c\n1,2,3,4\n", "2 columns are called 'c'"),
        ("1,2,4", "a,b,c\n1,2,3\n", "there are columns 1 to 3, got 4"),
        ("0,1,2", "a,b,c\n1,2,3\n", "there are columns 1 to 3, got 0"),
        ("a,b,c_in", "a,b,c_in\n1,2,3\n", "column 'c_in' is in in, but what is read are lengths in mm"),
        ("2,3,4", "t,1,x,3\nt,4,5,6\n", ":1: field 3 (l2) must be a number, got 'x'"),  # not skipped
    ],
)
def test_columns_chosen_wrongly(read, columns, content, expected):
    with pytest.raises(ValueError) as told:
        read(content, columns=columns)
    assert expected in str(told.value)


def test_units_of_angles_and_of_nothing(read):
    with pytest.raises(ValueError, match=r"'phi_deg' is in deg, but what is read are angles in rad$"):
        read("x,w,phi_deg,v\n1,2,3,4\n", (MIXED,))
    with pytest.raises(ValueError, match="'l1_mm' is in mm, but what is read are lengths without a unit"):
        read("l1_mm,l2,l3\n1,2,3\n", unit="1")


def test_stdin(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"1,2,3\n4,5\n")))
    with open_rows("-", [LENGTHS], unit="m") as reader:
        assert reader.fraction is None
        with pytest.raises(ValueError, match=r"^stdin:2: 2 fields"):
            list(reader)


def test_how_much_is_read(tmp_path):
    (tmp_path / "a.csv").write_text("1,2,3\n" * 4)
    with open_rows(str(tmp_path / "a.csv"), [LENGTHS], unit="m", chunk=1) as reader:
        assert [reader.fraction for _ in reader] == [0.25, 0.5, 0.75, 1.0]


finite_or_not = st.floats() | st.sampled_from([0.1, -0.0, 5e-324, 1.7976931348623157e308])


@given(st.lists(st.tuples(*[finite_or_not] * 3), min_size=1, max_size=20), st.integers(1, 25))
def test_what_is_written_is_read_bit_for_bit(tmp_path_factory, rows, chunk):
    path = tmp_path_factory.getbasetemp() / "round.csv"
    rows = np.array(rows)
    path.write_text(format_rows([rows[:, 0], rows[:, 1], ["a"] * len(rows), rows[:, 2]]))
    with open_rows(str(path), [LENGTHS], unit="m", columns="1,2,4", chunk=chunk) as reader:
        found = np.concatenate(list(reader))
    np.testing.assert_array_equal(found, rows)
    assert not np.any((np.signbit(found) != np.signbit(rows)) & ~np.isnan(rows))


field = st.sampled_from(
    ["1", "-2.5e3", " 1 ", "nan", "", "a", "1_0", "#", " #", '"1"', '"', "\r", "1\r2", "ü"]
)
line = st.lists(field, min_size=4, max_size=4) | st.lists(field, max_size=5)


@settings(max_examples=400)
@given(st.lists(line.map(",".join), max_size=3), st.sampled_from(["\n", "\r\n"]))
def test_the_fast_way_reads_what_the_slow_way_reads(tmp_path_factory, lines, end):
    """A comment makes a chunk slow."""
    path = tmp_path_factory.getbasetemp() / "random.csv"

    def read(chunk, last):
        path.write_bytes(end.join(["t,l1,l2,l3", "0,1,2,3", *lines, last]).encode())
        with open_rows(str(path), [LENGTHS], unit="m", chunk=chunk) as reader:
            try:
                return np.array_str(np.concatenate(list(reader)))
            except ValueError as error:
                return str(error)

    assert read(100, "") == read(100, "#") == read(1, "")


# Writing


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / ("ö " * 60 + ".csv")
    path.write_text("old")

    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), atomic_file(path) as file:
        stop(file.write(b"half"))
    assert path.read_text() == "old"
    with atomic_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_links_are_followed_and_devices_stay_devices(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    with output_file(tmp_path / "link") as file:
        file.write(b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_text() == "new"
    (tmp_path / "null").symlink_to("/dev/null")
    with output_file(tmp_path / "null") as file:
        file.write(b"gone")
    assert not (tmp_path / "null").is_file()
    with pytest.raises(IsADirectoryError), output_file(tmp_path):
        pass
    assert {p.name for p in tmp_path.iterdir()} == {"real", "link", "null"}
