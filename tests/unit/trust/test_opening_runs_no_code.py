"""Files that hold code are opened where this user wrote them here, or where they are trusted by name."""

import os
import shutil
from pathlib import Path

import pytest

from herglotz.cli import main
from herglotz.data import files as data_files
from herglotz.data.files import sealed_text
from herglotz.errors import InputError
from herglotz.export import compile, compile_c, load_c, load_exported
from tests.compilers import needs_compiler


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    """Call it, and the machine is another one: it has written nothing."""

    def move() -> None:
        monkeypatch.setattr(data_files, "_written", set())
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))

    return move


@needs_compiler
def test_a_header_that_was_sent_is_not_run(files, tmp_path, elsewhere, capsys):
    # fails if a constructor in a header runs before anything is asked
    path, ran = Path(shutil.copy(files("h"), tmp_path / "sent.h")), tmp_path / "ran"
    assert load_c(path).dof == 1  # written here
    evil = f'__attribute__((constructor)) static void f(void) {{ FILE *x = fopen("{ran}", "w"); if (x) fclose(x); }}\n'
    path.write_text(sealed_text("#include <stdio.h>\n" + evil + path.read_text().split("/* sha256")[0]))
    elsewhere()
    with pytest.raises(InputError, match="compile_c takes a model, got PosixPath; load_c opens a header"):
        compile_c(path)  # type: ignore[arg-type]
    for opened in (load_c, load_exported, compile):
        with pytest.raises(InputError, match="runs code that it holds"):
            opened(path)
    assert main(["verify", str(path)]) == 2
    assert "--trust-code" in capsys.readouterr().err
    assert not ran.exists()
    load_c(path, trust_code=True)
    assert ran.exists()  # the attack is one


@needs_compiler
def test_a_header_of_a_run_at_hand_is_generated_again(model, files, tmp_path, elsewhere):
    # fails if `verify FILE.h` needs trust where the run can tell what the file must be, or takes a changed file for it
    path = Path(shutil.copy(files("h"), tmp_path / "sent.h"))
    elsewhere()
    assert load_c(path, model=model).dof == 1
    text = path.read_text().split("/* sha256")[0]
    path.write_text(sealed_text(text.replace("stepper of a learned", "stepper of some learned")))
    elsewhere()
    with pytest.raises(InputError, match="runs code that it holds"):
        load_c(path, model=model)


def test_a_pt2_file_that_was_sent_is_not_opened(files, tmp_path, elsewhere):
    # fails if torch reads it, which evaluates and unpickles what stands in it
    path = shutil.copy(files("pt2"), tmp_path / "sent.pt2")
    elsewhere()
    with pytest.raises(InputError, match=r"sent\.pt2: opening it runs code that it holds"):
        load_exported(path)
    load_exported(path, trust_code=True)


def test_an_onnx_file_needs_no_trust(files, elsewhere):
    # fails if the format for strangers asks for trust
    path = files("onnx")
    elsewhere()
    assert load_exported(path).dof == 1


@needs_compiler
def test_a_cache_that_others_can_write_to_is_not_used(model, tmp_path, monkeypatch):
    # fails if a library planted in a folder with 0777 is loaded; it stands there under the right name
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = data_files.private_folder("c")
    assert folder == tmp_path / "herglotz" / "c"
    os.chmod(folder, 0o777)
    assert data_files.private_folder("c") != folder
    compile_c(model)
    assert not list(folder.iterdir())
    os.chmod(folder, 0o700)
    assert data_files.private_folder("c") == folder


@needs_compiler
def test_half_a_library_is_compiled_again(model, tmp_path, monkeypatch):
    # fails if half of a library is loaded, which ends the process with SIGBUS
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compile_c(model)
    (library,) = (tmp_path / "herglotz" / "c").iterdir()
    whole = library.read_bytes()
    library.unlink()  # not written in place: this process has it open
    library.write_bytes(whole[: len(whole) // 2])
    compile_c(model)
    assert len(library.read_bytes()) > len(whole) // 2


def test_one_temporary_folder_where_there_is_no_home(monkeypatch):
    # fails if every compilation leaves a folder behind
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/no")
    assert data_files.private_folder("c") == data_files.private_folder("c")


def test_an_internal_error_is_no_failed_check(monkeypatch, capsys):
    # fails if a fault of the package looks like a failed verification (1), or prints a traceback unasked
    import herglotz.verify

    def broken(*_, **__):
        raise KeyError("oops")

    monkeypatch.setattr(herglotz.verify, "verify", broken)
    assert main(["verify", "damped_oscillator"]) == 70
    error = capsys.readouterr().err
    assert "internal error: KeyError: 'oops'" in error
    assert "herglotz verify damped_oscillator" in error
    assert "Traceback" not in error
