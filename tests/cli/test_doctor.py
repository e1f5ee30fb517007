"""`prism-edge doctor`: it fails where something is broken, and says what to do."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from prism_edge.cli import checks
from prism_edge.cli.checks import FAIL, OK, WARN, Finding
from prism_edge.cli.main import main
from prism_edge.config import BusConfig, Config, DepthConfig, NetworkConfig, SourceConfig, StateConfig

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"


def levels(findings: Iterator[Finding]) -> list[str]:
    return [finding.level for finding in findings]


def test_this_machine_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "nothing failed"
    assert all(line.split()[0] in (OK, WARN) for line in lines[:-1])
    assert all(any(name in line for line in lines) for name in ("gtsam", "zenoh", "memlock", "model", "disk"))


def test_failure_ends_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--model", "missing.onnx"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith(FAIL)] == [
        line for line in lines if "missing.onnx" in line
    ]
    assert lines[-1] == "1 failed"


def test_wheel_that_does_not_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_wheel.py").write_text("raise ImportError('libGL.so.1:\\n  cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    [finding] = checks.check_wheels({"broken_wheel": "broken-wheel"})
    assert finding.level == FAIL
    assert finding.found == "libGL.so.1: cannot open"
    assert "broken-wheel" in finding.advice
    assert levels(checks.check_wheels({"no_such_module": "nothing"})) == [FAIL]


def test_certificates_that_can_not_be_read_or_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"ca": "ca.pem", "certificate": "rover.pem", "key": "rover.key"}
    files = {setting: str(tmp_path / name) for setting, name in names.items()}
    config = Config(network=NetworkConfig(endpoint="tls/0.0.0.0:7448", **files))
    assert levels(checks.check_certificates(config)) == [FAIL] * 3
    subprocess.run([str(MAKE), str(tmp_path), "rover", "anna"], check=True, timeout=60, capture_output=True)
    assert levels(checks.check_certificates(config)) == [OK]
    (tmp_path / "anna.key").rename(files["key"])
    [finding] = checks.check_certificates(config)
    assert (finding.level, "is not the key of" in finding.found) == (FAIL, True)
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"network": files}))
    assert main(["config", "--check", str(tmp_path / "mine.yaml")]) == 0
    assert f"warning: network.key: {files['key']} is not the key of" in capsys.readouterr().err
    Path(files["key"]).unlink()
    [finding] = checks.check_certificates(config)
    assert files["key"] in finding.found
    bare = Config(network=NetworkConfig(endpoint="tls/0.0.0.0:7448"))
    assert levels(checks.check_certificates(bare)) == [FAIL]
    assert levels(checks.check_certificates(Config())) == []
    assert sum(levels(check()).count(FAIL) for check in checks.all_checks(bare)) == 1


@pytest.mark.parametrize("check", [checks.check_model, checks.check_folders])
def test_what_it_could_not_look_at_is_not_passed_over(check, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("prism_edge.workers.sensor_network", "prism_edge.workers.state_directory"):
        monkeypatch.setitem(sys.modules, module, None)
    [finding] = check(Config(depth=DepthConfig(model="any")))
    assert finding.level == FAIL
    assert "can't be looked at" in finding.found


def test_model_that_is_no_network(tmp_path: Path) -> None:
    file = tmp_path / "net.onnx"
    file.write_bytes(b"no network")
    [finding] = checks.check_model(Config(depth=DepthConfig(model=str(file))))
    assert finding.level == FAIL
    assert "\n" not in finding.found
    assert levels(checks.check_model(Config())) == [WARN]


@pytest.mark.parametrize(
    ("depth", "expected"),
    [
        (DepthConfig(), [OK]),
        (DepthConfig(providers=("cpu", "AbacusExecutionProvider")), [OK, WARN]),
        (DepthConfig(providers=("AnExecutionProvider",), required=("AnExecutionProvider",)), [OK, FAIL]),
        (DepthConfig(providers=("abacus",)), [OK, FAIL]),
    ],
)
def test_provider_that_is_not_there(depth: DepthConfig, expected: list[str]) -> None:
    assert levels(checks.check_providers(Config(depth=depth))) == expected


def test_an_optional_dependency_that_is_taken_and_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prism_edge.cli.check.find_spec", lambda name: None)
    (finding,) = checks.check_extras(Config(source=SourceConfig(uri="oak:")))
    assert finding.level == FAIL
    assert "depthai is not installed" in finding.found
    assert not list(checks.check_extras(Config()))


def test_a_wheel_that_does_not_load_is_left_to_its_own_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prism_edge.cli.check", None)  # as where an import in it fails
    assert not list(checks.check_extras(Config(source=SourceConfig(uri="oak:"))))


@pytest.mark.parametrize("module", ["numpy", "cv2", "onnxruntime"])
def test_a_broken_wheel_ends_no_report(module: str, tmp_path: Path) -> None:
    (tmp_path / f"{module}.py").write_text("raise ImportError('libfoo.so: cannot open')")
    program = "import sys; from prism_edge.cli.main import main; sys.path.insert(0, sys.argv[1]); "
    program += "sys.exit(main(sys.argv[2:]))"
    command = [sys.executable, "-c", program, str(tmp_path), "doctor", "--model", "prism_nano"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines()[-1].endswith(" failed")


def test_two_onnxruntimes_that_overwrite_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    wheels = {"onnxruntime": ["onnxruntime-gpu", "onnxruntime", "onnxruntime"]}
    monkeypatch.setattr("importlib.metadata.packages_distributions", lambda: wheels)
    finding = next(iter(checks.check_providers(Config())))
    assert finding.level == FAIL
    assert finding.found == "onnxruntime and onnxruntime-gpu are both installed"


@pytest.mark.parametrize("config", [Config(robot="a/b"), Config(bus=BusConfig("nonsense"))])
def test_settings_that_zenoh_would_refuse(config: Config) -> None:
    assert levels(checks.check_zenoh(config)) == [FAIL]


def test_too_little_memory_or_disk() -> None:
    assert levels(checks.check_memory(1 << 40)) == [WARN]
    assert levels(checks.check_disk(1 << 40)) == [WARN]


@pytest.mark.parametrize("name", ["memory.max", "memory/memory.limit_in_bytes"])
def test_a_container_has_no_more_memory_than_it_may_take(name: str, tmp_path: Path) -> None:
    (tmp_path / "memory").mkdir()
    (tmp_path / name).write_text("314572800\n")
    (finding,) = checks.check_memory(cgroup=tmp_path)
    assert (finding.level, finding.found) == (WARN, "300 MB available")
    (tmp_path / name).write_text("max\n")
    assert levels(checks.check_memory(1, cgroup=tmp_path)) == [OK]


def test_no_temporary_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    assert levels(checks.check_disk())[-1] == FAIL


def test_where_the_daemon_writes_is_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    state = tmp_path / "state" / "prism-edge"  # which the daemon would make
    run, kept = checks.check_folders(Config(state=StateConfig(str(state))))
    assert (run.level, kept.level) == (OK, OK)
    assert run.found.endswith(str(tmp_path))
    assert kept.found.endswith(str(state))
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("prism_edge.supervisor.run_directory.default_parent", lambda: Path("/proc"))
    run, kept = checks.check_folders(Config(state=StateConfig("/proc/nowhere/state")))
    assert (run.level, kept.level) == (FAIL, WARN)
    assert "/proc/nowhere/state" in kept.found


def test_a_user_without_a_home_has_no_place_for_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    run, kept = checks.check_folders(Config())
    assert (run.level, kept.level) == (OK, WARN)
    assert "no home" in kept.found
    assert "state.directory" in kept.advice


def test_a_full_disk_is_found_where_the_daemon_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: open("/dev/full", "wb"))  # noqa: SIM115
    findings = list(checks.check_folders(Config()))
    assert [finding.level for finding in findings] == [FAIL, WARN]
    assert all("No space left on device" in finding.found for finding in findings)


def test_cameras_are_found_and_access_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = str(tmp_path / "video*")
    assert "no video device" in next(checks.check_cameras(pattern)).found
    (tmp_path / "video0").touch()
    assert next(checks.check_cameras(pattern)).found.endswith("video0")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert levels(checks.check_cameras(pattern)) == [WARN]


def test_a_network_on_another_host_is_not_looked_for_here() -> None:
    missing = ("AnExecutionProvider",)
    depth = DepthConfig(model="there.onnx", providers=missing, required=missing)
    config = Config(depth=depth, network=NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("depth",)))
    (finding,) = checks.check_model(config)
    assert (finding.level, "another host" in finding.found) == (OK, True)
    assert FAIL not in levels(checks.check_providers(config))


@pytest.mark.parametrize(
    ("locked", "files", "little", "level"),
    [
        (64 << 10, 255, True, WARN),
        (64 << 20, 256, False, OK),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, False, OK),
    ],
)
def test_limits_that_are_too_low_are_told(
    monkeypatch: pytest.MonkeyPatch, locked: int, files: int, little: bool, level: str
) -> None:
    """Locked memory is not needed as things are; open files are."""
    limits = {resource.RLIMIT_MEMLOCK: locked, resource.RLIMIT_NOFILE: files}
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limits[which], limits[which]))
    memlock, opened = checks.check_limits()
    assert (memlock.level, "too little" in memlock.found) == (OK, little)
    assert (opened.level, bool(opened.advice)) == (level, level == WARN)
