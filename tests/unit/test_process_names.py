"""A core's name: a command, or a TOML file; what is malformed is told in one line before anything is made."""

import shutil
import sys
from pathlib import Path

import pytest

import simtest
from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.estimators.names import absolute_names, close_cores, core_hashes, short_names
from simtest.estimators.process.core import parse_core
from tests.unit.core_helpers import BAD_CORE

TABLE = """
[core]
name = "mine"
command = "{command}"
"""


@pytest.fixture(autouse=True)
def no_core_stays():
    yield
    close_cores()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a program, a script that is not executable, and a model."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "program").symlink_to(shutil.which("true"))
    (tmp_path / "script.py").write_text(BAD_CORE.read_text())
    (tmp_path / "model.onnx").write_bytes(b"weights")
    (tmp_path / "inside").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("command:", "names no program"),
        ("command:   ", "names no program"),
        ("command: ''", "names no program"),
        ("command: 'half", "cannot be split into words"),
        ("command: no-such-program-anywhere --flag", "no program 'no-such-program-anywhere' on PATH"),
        ("command: ./missing", "./missing does not exist"),
        ("command: ./inside", "./inside is a folder; must be a program"),
        ("command: .", ". is a folder; must be a program"),
        ("command: ./model.onnx", "./model.onnx is not executable"),
        ("command: ./script.py", "./script.py is not executable"),
        ("command: script.py", 'a script is called with what runs it: "python script.py"'),
        ("command: model.onnx", "a program in this folder is named ./"),
        ("command: /dev/null", "/dev/null is a device"),
        ("command: ./garbage", "; must be a compiled program, or a script with #!"),
        ("command: ./program", "the core ended with exit code 0"),
        ("command: {python} script.py kind", "hello: kind 'film'"),
        ("command: {python} cone_axis.py none", "is called cone_axis, as an installed estimator is"),
        ("python script.py", "is no estimator's name; a program of yours needs 'command: ' before it"),
        ("./program", "is no estimator's name; a program of yours needs 'command: ' before it"),
        ("program", "'program': not installed; "),
        ("program", "; the file program is run by 'command: ./program'"),
        ("script.py", "; the file script.py is run by 'command: python script.py'"),
        ("missing.toml", "missing.toml"),
        ("inside.toml", "inside.toml"),
    ],
)
def test_a_name_that_cannot_be_run_is_refused_in_one_line(folder, text, words):
    (folder / "inside.toml").mkdir()
    (folder / "garbage").write_bytes(b"\x7fELF garbage")
    (folder / "garbage").chmod(0o755)
    shutil.copy(folder / "script.py", folder / "cone_axis.py")
    with pytest.raises(InputError) as caught:
        load_estimators([text.format(python=sys.executable)])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_name_given_twice_is_refused_and_a_file_hides_no_installed_estimator(folder):
    core = f"command: {sys.executable} script.py none"
    with pytest.raises(InputError, match="estimator 'script': given twice"):
        load_estimators([core, core])
    (folder / "cone_axis").write_text("")
    assert list(load_estimators(["cone_axis"])) == ["cone_axis"]


def test_nothing_is_made_before_the_core_has_greeted(folder):
    with pytest.raises(InputError, match="no such model"):
        simtest.validate("overview", folder / "run", estimators=[f"command: {sys.executable} script.py exit_at_start"])
    assert not (folder / "run").exists()


def test_files_among_the_arguments_are_absolute(folder):
    core = parse_core(f"command: {sys.executable} script.py --model=model.onnx --out=new inside text")
    assert core.arguments == (
        sys.executable, str(folder / "script.py"), f"--model={folder / 'model.onnx'}", "--out=new",
        str(folder / "inside"), "text",
    )  # fmt: skip
    assert set(core.hashes()) == {sys.executable, str(folder / "script.py"), str(folder / "model.onnx")}


def test_absolute_names_are_those_of_the_same_cores_elsewhere(folder, monkeypatch):
    (folder / "inside" / "core.toml").write_text(TABLE.format(command=f"{sys.executable} ../script.py"))
    (folder / "settings.toml").write_text("[core]\n")
    (folder / "bin").mkdir()
    (folder / "bin" / "launcher").symlink_to(sys.executable)
    monkeypatch.setenv("PATH", str(folder / "bin"))
    names = [
        f"command: {sys.executable} script.py 'two words'",
        f"command: {sys.executable} script.py --config settings.toml",
        "command: launcher script.py settings.toml",
        "inside/core.toml",
    ]
    before = [parse_core(name) for name in names]
    *absolute, other = absolute_names([*names, "cone_axis"])
    monkeypatch.chdir("/")
    after = [parse_core(name) for name in absolute]
    assert [core.arguments for core in after] == [core.arguments for core in before]
    assert [core.name for core in after] == [core.name for core in before] == ["script", "script", "script", "mine"]
    assert absolute_names(absolute) == tuple(absolute)
    assert other == "cone_axis"


def test_files_of_a_toml_file_are_looked_for_in_its_folder(folder):
    (folder / "inside" / "script.py").write_text(BAD_CORE.read_text())
    (folder / "inside" / "core.toml").write_text(TABLE.format(command=f"{sys.executable} script.py none"))
    core = parse_core("inside/core.toml")
    assert core.arguments[1] == str(folder / "inside" / "script.py")
    assert (core.name, core.time_limit_s) == ("mine", 10.0)
    assert set(load_estimators(["inside/core.toml"])) == {"mine"}


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('name = "two words"', "core.name"),
        ('name = "a/b"', "core.name"),
        ('name = "mine"\ncomand = "python a.py"', "core.comand = 'python a.py': unknown key"),
        ('name = "mine"\nfiles = ["lost.py"]', "core.files: lost.py is no file in .*; must be a file"),
    ],
)
def test_a_malformed_toml_file_is_refused(folder, more, words):
    (folder / "core.toml").write_text(f'[core]\ncommand = "./program"\n{more}\n')
    with pytest.raises(InputError, match=words):
        load_estimators(["core.toml"])


def test_further_files_make_another_core(folder):
    (folder / "helper.py").write_text("scale = 1")
    table = folder / "core.toml"
    table.write_text(
        TABLE.format(command=f"{sys.executable} script.py --fast") + 'files = ["helper.py", "model.onnx"]\n'
    )
    ((_, first),) = core_hashes(["core.toml"]).items()
    assert {str(folder / "helper.py"), str(folder / "model.onnx"), str(table)} <= set(first)
    (folder / "helper.py").write_text("scale = 2")
    assert core_hashes(["core.toml"]) != {"core.toml": first}


def test_the_kind_and_the_environment_of_a_toml_file_hold(folder, monkeypatch):
    line = TABLE.format(command=f"{sys.executable} script.py none")
    (folder / "core.toml").write_text(line + 'kind = "frame"')
    with pytest.raises(InputError, match=r"kind patch; core\.toml says frame"):
        load_estimators(["core.toml"])
    (folder / "core.toml").write_text(line + 'environment = ["LICENCE_SERVER", "ABSENT_ONE"]')
    monkeypatch.setenv("LICENCE_SERVER", "port 3")
    monkeypatch.setenv("OTHER_THING", "3")
    variables = parse_core("core.toml").variables()
    assert variables["LICENCE_SERVER"] == "port 3"
    assert not {"OTHER_THING", "ABSENT_ONE"} & set(variables)


def test_the_same_core_is_started_once_and_a_changed_one_anew(folder):
    core = f"command: {sys.executable} script.py none"
    (first,) = load_estimators([core]).values()
    (again,) = load_estimators([core]).values()
    assert again.core is first.core
    (folder / "script.py").write_text(BAD_CORE.read_text() + "\n# changed\n")
    (changed,) = load_estimators([core]).values()
    assert changed.core is not first.core
    assert first.core._child is None


def test_a_closed_core_greets_anew_since_what_its_script_imports_may_have_changed(folder):
    script = BAD_CORE.read_text().replace('"version": "0.1"', '"version": open(VERSION).read()')
    (folder / "version").write_text("0.1")
    (folder / "script.py").write_text(script.replace("HANG_S = 600", f"HANG_S, VERSION = 600, '{folder}/version'"))
    core = f"command: {sys.executable} script.py none"
    (first,) = load_estimators([core]).values()
    close_cores()
    (folder / "version").write_text("0.2")
    (second,) = load_estimators([core]).values()
    assert [each.core.hello.version for each in (first, second)] == ["0.1", "0.2"]


def test_the_command_line_takes_a_core(folder, here):
    from PIL import Image

    Image.linear_gradient("L").resize((64, 64)).save("picture.png")
    core = f"command: {sys.executable} {folder / 'script.py'} protocol"
    (folder / "camera.toml").write_text("width = 64\nheight = 64\nfx = 46.0\nfy = 46.0\ncx = 32.0\ncy = 32.0\n")
    code, _, errors = here("reconstruct", "picture.png", "--camera", "camera.toml", "--out", "out", "--estimator", core)
    assert code != 0
    assert len(errors) == 1
    assert "hello: protocol 2; simtest speaks 1" in errors[0]


def test_a_command_has_the_name_of_what_the_user_wrote(folder):
    for command, name in (
        ("./program --table model.onnx", "program"),
        ("./program", "program"),
        ("python3 script.py", "script"),
        ("python3 script.py model.onnx", "script"),
        (f"{sys.executable} script.py --weights model.onnx", "script"),
        (f"{sys.executable} -c pass", Path(sys.executable).stem),
        ("true", "true"),
    ):
        assert parse_core(f"command: {command}").name == name
        assert short_names(["cone_axis", f"command: {command}"]) == ("cone_axis", name)
