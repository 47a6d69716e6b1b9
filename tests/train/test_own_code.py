"""Functions of users by `module:function` or by file."""

from __future__ import annotations

import re

import pytest

from data_pipeline.errors import DataError
from train.own_code import absolute, load_own


def write(path, content):
    path.write_text(content)
    return path


def test_a_function_is_loaded_from_a_file_and_identified_by_its_source(tmp_path):
    write(tmp_path / "beside.py", "NUMBER = 7\n")
    path = write(tmp_path / "mine.py", "import beside\ndef number():\n    return beside.NUMBER\n")
    code = load_own(f"{path}:number", "--policy")
    assert code.function() == 7
    assert (code.module, code.name) == ("mine.py", "number")
    assert load_own(f"{path}:number", "--policy").function is code.function  # the file is run once
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    write(moved / "mine.py", path.read_text())
    assert load_own(f"{moved / 'mine.py'}:number", "--policy").identity == code.identity
    write(path, "import beside\ndef number():\n    return beside.NUMBER + 1\n")
    edited = load_own(f"{path}:number", "--policy")
    assert edited.function() == 8
    assert edited.identity["source"] != code.identity["source"]
    assert not list(tmp_path.glob("__pycache__/mine*"))


def test_a_function_is_loaded_from_a_module(tmp_path, monkeypatch):
    write(tmp_path / "own_module_of_a_test.py", "from train.own_code import absolute\ndef one():\n    return 1\n")
    monkeypatch.chdir(tmp_path)  # where Python does not look for modules, but this does
    code = load_own("own_module_of_a_test:one", "--encoder")
    assert (code.module, code.name, code.function()) == ("own_module_of_a_test", "one", 1)
    elsewhere = load_own("own_module_of_a_test:absolute", "--encoder")
    assert elsewhere.identity["source"] != code.identity["source"]  # the file that defines it counts too
    assert absolute("a.py:f") == f"{tmp_path / 'a.py'}:f"
    assert absolute("module:f") == "module:f"


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("mine", "is not of the form module:function or path/to/file.py:function"),
        ("mine.py", "is not of the form"),
        (":f", "is not of the form"),
        ("mine.py:a b", "is not of the form"),
        ("nowhere.py:f", r"nowhere.py cannot be read \(No such file"),
        ("no_such_module_at_all:f", "there is no module no_such_module_at_all"),
        ("train.no_such_module:f", "there is no module train.no_such_module"),
        ("..train:f", "there is no module ..train"),
        ("mine.py:g", r"has no function 'g' \(it has f\)"),
        ("mine.py:number", r"has no function 'number' \(it has f\)"),
        ("broken.py:f", r"broken.py cannot be imported \(SyntaxError: "),
        ("ends.py:f", r"ends.py cannot be imported \(it ends the program\)"),
        ("lacks.py:f", r"lacks.py cannot be imported \(ModuleNotFoundError: No module named 'no_such_package'\)"),
        ("math:sin", "math has no source file"),
    ],
)
def test_what_cannot_be_loaded_is_one_sentence(reference, said, tmp_path, monkeypatch):
    write(tmp_path / "mine.py", "from os.path import join\nnumber = 3\ndef f(): pass\n")
    write(tmp_path / "broken.py", "def f(:\n")
    write(tmp_path / "ends.py", "raise SystemExit(3)\n")
    write(tmp_path / "lacks.py", "import no_such_package\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=f"^--policy {re.escape(reference)}.*{said}") as error:
        load_own(reference, "--policy")
    assert "\n" not in str(error.value)
