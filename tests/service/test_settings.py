"""Where settings come from, which of them wins, and what is said of bad ones."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sidelong.errors import SettingsError
from sidelong_service.settings import ServiceSettings, check_loopback, load_settings


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("SIDELONG_"):
            monkeypatch.delenv(name)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "service.yaml"


def refused(file: Path | None) -> str:
    with pytest.raises(SettingsError) as caught:
        load_settings(file)
    return str(caught.value)


def test_defaults_are_a_simulated_cell_on_this_machine() -> None:
    settings = load_settings()
    assert (settings.host, settings.port) == ("127.0.0.1", 8000)
    assert (settings.cell.simulated, settings.cell.camera.driver, settings.cell.arm.driver) == (
        True,
        "simulated",
        "mock",
    )
    check_loopback(settings.host)


def test_a_file_sets_fields_and_leaves_the_others(file: Path) -> None:
    file.write_text(
        "port: 9000\ndatasets: {robi: /data/robi}\ncell:\n  name: cell 3\n  dome: {azimuths: 4, elevations_deg: [70]}\n"
    )
    settings = load_settings(file)
    assert settings.port == 9000
    assert settings.datasets == {"robi": Path("/data/robi")}
    assert (settings.cell.name, settings.cell.arm.driver) == ("cell 3", "mock")
    assert (settings.cell.dome.azimuths, settings.cell.dome.elevations_deg) == (4, (70,))


@pytest.mark.parametrize("content", ["", "# nothing\n", "{}"])
def test_an_empty_file_is_as_none(file: Path, content: str) -> None:
    file.write_text(content)
    assert load_settings(file).model_dump() == load_settings().model_dump()


def test_the_environment_wins_over_the_file_and_an_option_over_both(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text("port: 9000\ndata_dir: /from/file\n")
    monkeypatch.setenv("SIDELONG_PORT", "9001")
    settings = load_settings(file)
    assert (settings.port, settings.data_dir) == (9001, Path("/from/file"))
    assert load_settings(file, port=9002).port == 9002
    assert load_settings(file, port=None).port == 9001


def test_nested_fields_come_from_the_environment(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text("cell: {name: from file, arm: {driver: mock, settings: {speed_factor: 2}}}\n")
    monkeypatch.setenv("SIDELONG_CELL__ARM__DRIVER", "replay")
    monkeypatch.setenv("SIDELONG_CELL__CAMERA", '{"driver": "replay", "settings": {"scene": 3}}')
    settings = load_settings(file)
    assert (settings.cell.name, settings.cell.arm.driver) == ("from file", "replay")
    assert settings.cell.arm.settings == {"speed_factor": 2}
    assert settings.cell.camera.settings == {"scene": 3}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("prot: 9000", ["prot", "not permitted", "9000"]),
        ("cell: {nmae: x}", ["cell.nmae", "not permitted"]),
        ("cell: {arm: {driver: mock, spede: 1}}", ["cell.arm.spede", "not permitted"]),
        ("port: 70000", ["port", "65535", "70000"]),
        ("port: x", ["port", "integer", "'x'"]),
        ("cell: {target_m: [.nan, 0, 0]}", ["cell.target_m.0", "finite", "nan"]),
        ("cell: {target_m: [1, 2]}", ["cell.target_m"]),
        ("cell: {flange_T_camera: [1, 0]}", ["cell.flange_T_camera", "16"]),
        ("cell: {dome: {azimuths: -3}}", ["cell.dome.azimuths", "-3", "greater than or equal to 1"]),
        ("cell: {arm: {driver: ''}}", ["cell.arm.driver", "at least 1 character"]),
        ("datasets: {../x: /tmp}", ["datasets", "../x", "pattern"]),
        ("[1, 2]", ["holds list", "names with values"]),
        ("just words", ["holds str"]),
        ("port: [", ["not YAML", "line"]),
        ("a: b: c", ["not YAML"]),
        ("!!python/object/apply:os.getcwd []", ["not YAML"]),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_the_field(file: Path, content: str, words: list[str]) -> None:
    file.write_text(content)
    message = refused(file)
    assert message.startswith(f"{file}: ")
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_a_file_that_is_no_text_or_no_file_is_refused(file: Path) -> None:
    assert "no such configuration file" in refused(file)
    assert "no such configuration file" in refused(file.parent)
    file.write_bytes(b"\x93\xff\x00\xfe")
    assert "not YAML" in refused(file)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("SIDELONG_PORT", "many", ["port", "'many'"]),
        ("SIDELONG_CELL__NONSENSE", "1", ["cell.nonsense", "not permitted"]),
        ("SIDELONG_CELL", "{bad", ["environment", "cell"]),
        ("SIDELONG_DATASETS", "[1]", ["datasets", "dictionary"]),
    ],
)
def test_a_bad_environment_is_refused_with_the_field(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, words: list[str]
) -> None:
    monkeypatch.setenv(name, value)
    message = refused(None)
    assert all(word in message for word in words), message


def test_settings_do_not_change() -> None:
    with pytest.raises(ValueError, match="frozen"):
        ServiceSettings().port = 1


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_addresses_are_served(host: str) -> None:
    check_loopback(host)


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "::", "192.168.1.10", "10.0.0.1", "8.8.8.8", "example.com", "", "localhost.example.com", "127.0.0"],
)
def test_other_addresses_are_refused_and_named(host: str) -> None:
    with pytest.raises(SettingsError, match="not a loopback address") as caught:
        check_loopback(host)
    assert repr(host) in str(caught.value)
