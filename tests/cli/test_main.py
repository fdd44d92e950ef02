# SPDX-License-Identifier: Apache-2.0
"""The command as a person meets it: in a process of its own."""

import dataclasses
import inspect
import json

import pytest

from manyeyes import __version__
from manyeyes.cli import main as cli


def test_help_lists_every_command(capsys) -> None:
    assert cli.main(["--help"]) == 0
    output = capsys.readouterr().out
    assert all(f"  {command} " in output for command in cli.COMMANDS)


ALL_COMMANDS = [command for command in cli.COMMANDS if command not in cli.COMMAND_GROUPS]
ALL_COMMANDS += [f"{group} {command}" for group, commands in cli.COMMAND_GROUPS.items() for command in commands]


@pytest.mark.parametrize("command", ALL_COMMANDS)
def test_every_command_has_options_with_help(command, capsys) -> None:
    options, run, about = cli.load_command(command)
    assert about and callable(run)
    with pytest.raises(SystemExit) as stop:
        cli.main([*command.split(), "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"manyeyes {command}" in text
    fields = dataclasses.fields(options)
    assert fields and all(f.name.replace("_", "-") in text.lower() for f in fields)
    # tyro prints nothing between a flag and its default where the field has no docstring.
    for part in filter(dataclasses.is_dataclass, options.__mro__):
        texts = inspect.getsource(part).count('\n    """')
        assert texts == len(inspect.get_annotations(part)) + 1, "an option is without a line of help"


def test_an_unknown_command_lists_the_known(capsys) -> None:
    assert cli.main(["demmo"]) == 2
    assert capsys.readouterr().err == (
        "manyeyes: there is no command 'demmo'; did you mean demo? Known commands: "
        "demo, check, simulate, train, finetune, fit-codebook, calibrate, evaluate, replay, export, view, pose, map, live, keys, "
        "study, report, doctor.\n"
    )


def test_a_group_lists_its_commands_and_no_other(capsys) -> None:
    assert cli.main(["map"]) == 0
    output = capsys.readouterr().out
    assert (
        all(f"  {command} " in output for command in cli.COMMAND_GROUPS["map"])
        and "usage: manyeyes map COMMAND" in output
    )
    assert cli.main(["map", "fuze"]) == 2
    assert "did you mean fuse? Known commands: build, simulate, import, fuse" in capsys.readouterr().err


def test_a_designed_error_is_one_line_and_exits_with_1(monkeypatch, capsys) -> None:
    from manyeyes.cli import doctor
    from manyeyes.datatypes import RecordingError

    def fail(options: object) -> None:
        raise RecordingError("here/is/a.yaml: no lidar_pose;\n write one.")

    monkeypatch.setattr(doctor, "main", fail)
    assert cli.main(["doctor"]) == 1
    assert capsys.readouterr().err == "manyeyes: here/is/a.yaml: no lidar_pose; write one.\n"


def test_ctrl_c_is_one_line_and_exits_with_130(monkeypatch, capsys) -> None:
    from manyeyes.cli import doctor

    def stop(options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "main", stop)
    assert cli.main(["doctor"]) == 130
    assert capsys.readouterr().err == "manyeyes: stopped.\n"


def test_a_missing_file_is_one_line_and_exits_with_1(monkeypatch, capsys) -> None:
    from manyeyes.cli import doctor

    monkeypatch.setattr(doctor, "main", lambda options: open("/no/such/file"))  # noqa: PTH123, SIM115
    assert cli.main(["doctor"]) == 1
    assert capsys.readouterr().err == "manyeyes: /no/such/file: No such file or directory\n"


def test_version(capsys) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"manyeyes {__version__}\n"


def test_doctor_prints_json_for_a_bug_report(capsys) -> None:
    assert cli.main(["doctor", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    import torch

    assert output["versions"]["torch"] == torch.__version__ and output["torch_threads"] == torch.get_num_threads()
    assert {e["name"] for e in output["extras"]} == {
        "sim",
        "map",
        "view",
        "av2",
        "cloud",
        "dask",
        "ray",
        "icp",
        "ros",
        "train",
        "live",
        "metrics",
        "rerun",
    }
    assert {"cpu", "cores", "system", "git_commit", "weights", "towns", "towns_from", "package"} <= set(output)


def test_doctor_names_the_pip_line_of_a_missing_extra_and_the_commands_that_need_it(monkeypatch, capsys) -> None:
    from manyeyes.cli import doctor, requirements

    for module in (doctor, requirements):
        monkeypatch.setattr(module, "is_installed", lambda name: name != "pyogrio")
    assert cli.main(["doctor"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    needed_by = "map import (sources *.gpkg, *.geojson), map export (format geopackage, pmtiles)"
    assert f"missing pyogrio: pip install 'manyeyes[map]'; needed by {needed_by}" in output
    assert "needed by demo" not in output


def test_doctor_names_damaged_weights_and_exits_with_1(monkeypatch, capsys, tmp_path) -> None:
    from pathlib import Path

    from manyeyes.models import pretrained, shipped

    source, folder = Path(shipped.__file__).with_name("weights"), tmp_path / "weights"
    folder.mkdir()
    (folder / shipped.MANIFEST).write_text((source / shipped.MANIFEST).read_text())
    whole = (source / "costr-small.safetensors").read_bytes()
    (folder / "costr-small.safetensors").write_bytes(whole[:1000])
    monkeypatch.setattr(shipped, "files", lambda package: tmp_path)
    monkeypatch.setattr(pretrained, "list_detectors", lambda: ("costr-small",))
    assert cli.main(["doctor", "--json"]) == 1
    output = capsys.readouterr()
    statuses = {status["name"]: status for status in json.loads(output.out)["weights"]}
    expected = {
        "costr-base",
        "costr-small",
        "feakm-small",
        "map-small-camera",
        "map-small-fusion",
        "map-small-lidar",
        "pose-verifier-small",
    }
    assert set(statuses) == expected
    assert f"1,000 bytes instead of {len(whole):,}" in statuses["costr-small"]["problem"]
    assert "No such file" in statuses["feakm-small"]["problem"]
    assert output.err.startswith(f"manyeyes: {folder}") and output.err.count("\n") == 1
    assert "pip install --force-reinstall manyeyes" in output.err


def test_an_argument_that_could_not_be_decoded_is_one_line(capsys) -> None:
    assert cli.main(["view", "/tmp/\udcc3\udcbc"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "PYTHONUTF8=1" in err and "\\udcc3" in err


def test_letters_that_the_output_lacks_are_escaped(monkeypatch) -> None:
    import io
    import sys

    from manyeyes.cli import doctor

    output = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setattr(doctor, "main", lambda options: print("1\N{DEGREE SIGN}"))
    assert cli.main(["doctor"]) == 0
    output.flush()
    assert output.buffer.getvalue() == b"1\\xb0\n"  # pyright: ignore[reportAttributeAccessIssue]


def test_a_lack_of_memory_and_a_path_that_cannot_be_encoded_are_one_line(monkeypatch, capsys) -> None:
    from manyeyes.cli import doctor

    def encode(options: object) -> None:
        "a\udcc3".encode()

    def fill(options: object) -> None:
        raise MemoryError

    for run, expected in ((encode, "PYTHONUTF8=1"), (fill, "not enough memory")):
        monkeypatch.setattr(doctor, "main", run)
        assert cli.main(["doctor"]) == 1
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and expected in err
