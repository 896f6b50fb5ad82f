"""Texts of numbers, with and without pyarrow: values against those that are written in the test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.text_reader import read_text

pytestmark = pytest.mark.one_python

NAN = np.nan


@pytest.fixture(params=["pyarrow", "no pyarrow"])
def path(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if request.param != "pyarrow":
        monkeypatch.setattr("vtbdrake.recording.text_reader.find_spec", lambda name: None)
    return tmp_path / "table.csv"


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        (b"t,q\n0,1\n0.1,2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\r\n0,1\r\n\r\n0.1,2", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\r0,1\r0.1,2\r", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"\xef\xbb\xbft;q\n0;1\n0.1;2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"\xef\xbb\xbf0;1\n0.1;2\n", {"0": [0.0, 0.1], "1": [1.0, 2.0]}),
        (b'"t", "q"\n0,"1"\n"0.1",2\n', {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\n0,1,\n0.1,2,\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\n0,1\n0.1,2,\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\n0,\n0.1, \n0.2,nan\n0.3,-inf\n", {"t": [0.0, 0.1, 0.2, 0.3], "q": [NAN, NAN, NAN, -np.inf]}),
        (b"t,q\n 0 , +1 \n1e-1,1_0\n", {"t": [0.0, 0.1], "q": [1.0, 10.0]}),
        (b"t,q\n0,1\n0.1,2\n0.2", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\n0,1\n0.1,2\n0.2\n\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\n0,1\n0.1,2\n0.2,3", {"t": [0.0, 0.1, 0.2], "q": [1.0, 2.0, 3.0]}),
        (b"t q\n0 1\n0.1 2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"  t   q\n  0   1 \n0.1\t2\n\n 0.2  3", {"t": [0.0, 0.1, 0.2], "q": [1.0, 2.0, 3.0]}),
        (b"  0   1 \r\n 0.1  2\r\n", {"0": [0.0, 0.1], "1": [1.0, 2.0]}),
        (b"q\n1\n\n2\n", {"q": [1.0, 2.0]}),
        (b"stamp\n1732900000123456789\n", {"stamp": [float(1732900000123456789)]}),
        (b"t,q\n0,0.1234567890123456789\n", {"t": [0.0], "q": [0.1234567890123456789]}),
        (b"t,frame,q\n0,base,1\n0.1,\xff,2\n", {"t": [0.0, 0.1], "frame": ["base", "\ufffd"], "q": [1.0, 2.0]}),
        (b"t,frame\n0,\n0.1,base\n", {"t": [0.0, 0.1], "frame": ["nan", "base"]}),
        (b"t;q\n0;1,5\n0,1;-2,5e1\n0,2;\n", {"t": [0.0, 0.1, 0.2], "q": [1.5, -25.0, NAN]}),
        (b"0,5;1,25\n1,5;2\n", {"0": [0.5, 1.5], "1": [1.25, 2.0]}),
        (b"t q\n0,5 1,25\n1 2.5\n", {"t": [0.5, 1.0], "q": [1.25, 2.5]}),
        (b"# of the arm, 2026\nt,q\n0,1\n0.1,2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"# of the arm\r\n# t q\r\n0 1\r\n0.1 2\r\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"# t, q\n0,1\n# paused\n0.1,2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"t,q\n# s, rad\n# of the arm\n0,1\n0.1,2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"0 1\n# s rad\n0.1 2\n", {"0": [0.0, 0.1], "1": [1.0, 2.0]}),
        (b"# of the whole arm\n0,1\n0.1,2\n", {"0": [0.0, 0.1], "1": [1.0, 2.0]}),
        (b"% of the arm\n// at noon\n\nt,q\n0,1\n% paused\n0.1,2\n", {"t": [0.0, 0.1], "q": [1.0, 2.0]}),
        (b"sep=;\nt;q\n0;1,5\n", {"t": [0.0], "q": [1.5]}),
        (b"t;q\n0;1\n0,1;1,5\n", {"t": [0.0, 0.1], "q": [1.0, 1.5]}),
        (b'"t","q"\n"0","1,5"\n"0,1","2,5"\n', {"t": [0.0, 0.1], "q": [1.5, 2.5]}),
        (b"t,day,on\n0,2026-11-29,true\n", {"t": [0.0], "day": ["2026-11-29"], "on": ["true"]}),
    ],
)
def test_columns_of_a_text(path: Path, text: bytes, columns: dict[str, list[float]]) -> None:
    path.write_bytes(text)
    table = read_text(path)
    assert list(table) == list(columns)
    for name, values in columns.items():
        np.testing.assert_array_equal(table[name], values, strict=False)
        assert np.asarray(table[name]).dtype.kind == np.array(values).dtype.kind


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "fewer than two lines"),
        (b"t,q\n", "fewer than two lines"),
        (b"# only a comment\n", "fewer than two lines"),
        (b"# t t\n0 1\n", "two columns 't'"),
        (b"t,t\n0,1\n", "two columns 't'"),
        (b"t,q\n0,1\n1\n2,3\n", "row 1 has 1 columns, not 2"),
        (b"t,q\n0\n1,2\n", "row 0 has 1 columns, not 2"),
        (b"t  q\n0  1\n1\n2  3\n", "row 1 has 1 columns, not 2"),
        (b"t,q\n0,004,0,1\n0,008,0,2\n", "row 0 has 4 columns, but there are 2 names: decimal commas"),
        (b"t,q\n0,004e+00,0,1e-02\n0,008e+00,0,2e-02\n", "row 0 has 4 columns, but there are 2 names: decimal commas"),
        (b"t,q\n0,1,2\n0.1,2,3\n", "row 0 has 3 columns, but there are 2 names: decimal commas"),
        (b"run 7, noon\nt,q,u\n0,1,2.5\n", "row 0 has 3 columns, but there are 2 names: is there a line above"),
        (b"Run of the arm\nt,q\n0,1\n", r"row 0 has 1 columns, not 4 .*Begin it with #"),
        ("t,q\n0,1\n1,2\n".encode("utf-16"), "no text in UTF-8: if it is a table in UTF-16"),
        ("t;q\n0;1\n1;2\n".encode("utf-16-le"), "no text in UTF-8"),
    ],
)
def test_bad_text_is_refused(path: Path, text: bytes, message: str) -> None:
    path.write_bytes(text)
    with pytest.raises(LogError, match=message):
        read_text(path)
