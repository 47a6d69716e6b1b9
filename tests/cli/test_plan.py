"""`mevs train --plan`, and the launches of docs/scaling.md, which all can start."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

import train.planning.plan
from mevs_jax.cli.planning import plan_text
from tests.cli.conftest import ended, refused

SCALING = Path(__file__).resolve().parents[2] / "docs" / "scaling.md"
POD = ("--distributed", "--plan", "--plan-devices", "64", "--plan-processes", "16")
LARGE = ("--classifier.optimiser.batch-size", "256", "--entropy.optimiser.batch-size", "256")
MILLION = ("--plan-objects", "1000000")


@pytest.fixture
def without_costs(monkeypatch):
    """Plans that only count, at once."""
    names = ("weights_bytes", "state_bytes", "gradients_bytes", "inputs_bytes", "activations_bytes")
    monkeypatch.setattr(
        train.planning.plan, "memory_of", lambda *_: dict.fromkeys((*names, "view_activations_bytes"), 1)
    )
    monkeypatch.setattr(train.planning.plan, "flop_of", lambda *_: 1.0)


@pytest.mark.parametrize(
    "preset", ["tiny", *(pytest.param(preset, marks=pytest.mark.slow) for preset in ("small", "thesis"))]
)
def test_a_pod_and_a_million_objects_are_planned_from_any_machine(preset, at_once, tmp_path):
    found = at_once("train", "--preset", preset, *POD, *LARGE, *MILLION, "--json", "--out", tmp_path / "run")
    assert (found.returncode, found.stderr) == (0, "")
    assert not (tmp_path / "run").exists()
    plan = json.loads(found.stdout)
    assert plan["layout"] == {"devices": 64, "processes": 16, "data": 64, "model": 1}
    assert plan["data"]["objects"] == {"train": 1_000_000, "val": 250_000}
    assert [network["network"] for network in plan["networks"]] == ["classifier", "entropy predictor"]
    for network in plan["networks"]:
        assert (network["device_views"], network["process_views"]) == (4, 16)
        assert network["device_bytes"] > network["state_bytes"] > 2.9 * network["weights_bytes"] > 0
        assert network["step_flop"] == 64 * network["device_flop"] > 0
    said = plan_text(plan)
    assert said.startswith("64 devices (64 data × 1 model) of 16 processes\ndata set, not made yet: 1,000,000 objects")
    assert max(map(len, said.splitlines())) <= 120
    if preset == "thesis":  # the example of the documentation, but for what another version of JAX counts otherwise
        counted = ("memory", "  weights", "  gradients", "  activations", "operations")
        lines = [line for line in said.splitlines() if not line.startswith(counted)]
        shown = re.sub(r" +", " ", SCALING.read_text())
        assert len(lines) > 10
        assert [line for line in lines if re.sub(r" +", " ", line).strip() not in shown] == []


def test_the_data_set_that_is_there_is_planned_for(data, at_once, tmp_path):
    (tmp_path / "data").symlink_to(data)
    said = ended(at_once("train", "--preset", "tiny", "--plan", "--out", tmp_path))
    assert "data set: 30 objects to train on, 10 for validation, 10 classes, 6 views of 32×32" in said
    assert re.search(r"of an object +[\d.]+ kB, measured +[\d.]+ kB, measured", said)
    assert "8 an epoch, 16 in 2 epochs" in said
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--plan",), "no data set in .*; create one with: mevs data --out .*, or .* by --plan-objects N"),
        (("--plan-devices", "8"), "--plan-devices is for a plan; add --plan"),
        (("--json",), "--json is for a plan"),
        (("--plan", "--distributed"), "say how many devices and processes"),
        (("--plan", "--distributed", "--plan-devices", "8"), "say how many devices and processes"),
        (("--plan", "--plan-devices", "8", "--plan-processes", "8"), "8 processes train together with --distributed"),
        ((*POD, *MILLION), "classifier: a batch of 16 views cannot be shared equally by 64 devices; .*such as 64"),
        (
            (*POD, *MILLION, *LARGE[:2], "--entropy.optimiser.batch-size", "100"),
            "entropy predictor: a batch of 100 views cannot be shared equally by 64 devices; .*such as 128",
        ),
        ((*POD, *MILLION, *LARGE, "--model-devices", "3"), "--model-devices 3 does not divide the 4 devices"),
        ((*POD[:4], "--plan-processes", "12", *MILLION), "64 devices cannot be shared equally by 12 processes"),
        (
            (*POD, *MILLION, *LARGE, "--classifier.optimiser.views-per-object", "32"),
            "a batch of 256 views, 32 of an object, cannot be read equally by 16 processes; .*such as 512",
        ),
        ((*POD, *MILLION, *LARGE, "--seeds", "3"), "a plan is of one training, and --seeds is 3; add --seeds 1"),
        ((*POD, *LARGE, "--plan-objects", "0"), "--plan-objects must be at least 1"),
    ],
)
def test_what_cannot_be_is_one_sentence(options, told, refuses, tmp_path, without_costs):
    assert re.search(told, refuses("train", "--preset", "tiny", *options, "--out", tmp_path))


def test_all_networks_are_checked_before_the_first_is_trained(data, refuses, tmp_path):
    """By `mevs train`, and by `mevs run` before it makes data."""
    three = ("--entropy.optimiser.parts", "3")
    told = "entropy predictor: a batch of 16 views in 3 parts cannot be shared equally"
    assert told in refuses("run", "--preset", "tiny", *three, "--out", tmp_path / "run")
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "data").symlink_to(data)
    assert told in refuses("train", "--preset", "tiny", *three, "--out", tmp_path / "train")
    (tmp_path / "seeds").mkdir()
    (tmp_path / "seeds" / "data").symlink_to(data)
    assert "entropy predictor: a batch of 16 views in 3 parts" in refuses(
        "train", "--preset", "tiny", *three, "--seeds", "2", "--out", tmp_path / "seeds"
    )
    assert not (tmp_path / "seeds" / "seeds" / "classifier_together").exists()
    assert not (tmp_path / "run" / "data").exists()
    assert not (tmp_path / "train" / "classifier").exists()


@dataclass(frozen=True)
class Launch:
    """A documented `mevs train`: its options, and the devices and processes that it is for."""

    options: tuple[str, ...]
    devices: int
    processes: int


def shape_of(line: str, comment: str) -> tuple[int, int]:
    """Devices and processes of a command, from what stands before `mevs` and the comment above; they have to agree."""
    if line.startswith("srun "):
        given = dict(re.findall(r"--([\w-]+)=(\d+)", line.split("mevs")[0]))
        assert set(given) == {"nodes", "ntasks-per-node", "gpus-per-node"}, line
        nodes, tasks, devices = int(given["nodes"]), int(given["ntasks-per-node"]), int(given["gpus-per-node"])
        assert tasks == devices, "JAX gives a process of Slurm one GPU"
        found = nodes * devices, nodes * tasks
    elif "--distributed" in line:
        told = re.search(r"(\d+) processes, (\d+) devices", comment)
        assert told, f"the processes and devices of a launch are not told above it: {line}"
        found = int(told[2]), int(told[1])
        if by_hand := re.search(r"JAX_NUM_PROCESSES=(\d+)", line):
            assert found[1] == int(by_hand[1])
    elif visible := re.search(r"CUDA_VISIBLE_DEVICES=([\d,]+)", line):
        found = len(visible[1].split(",")), 1
    else:  # as many as a large machine has
        simulated = re.search(r"JAX_NUM_CPU_DEVICES=(\d+)", line)
        found = int(simulated[1]) if simulated else 8, 1
    if told := re.search(r"(\d+) processes, (\d+) devices", comment):
        assert found == (int(told[2]), int(told[1])), line
    return found


def options_of(command: str) -> tuple[str, ...]:
    words = command.split("mevs train")[1].replace("…", "").split('"')[0]
    return tuple(shlex.split(words))


def launches(text: str) -> list[Launch]:
    """Every `mevs train` of a page: in code, in tables, and in a Kubernetes job; those that are plans already are left out."""
    found, above = [], ""
    plain = re.sub(r"```yaml.*?```", "", text, flags=re.S)
    for line in plain.splitlines():
        in_code = [line.strip()] if line.startswith("    ") else re.findall(r"`([^`]*)`", line)
        for code in (code.split("  #")[0] for code in in_code):
            if "mevs train" in code and "--plan" not in code:
                found.append(Launch(options_of(code), *shape_of(code, above)))
        above = line
    for block in re.findall(r"```yaml\n(.*?)```", text, flags=re.S):
        found += [of_job(job) for job in yaml.safe_load_all(block) if job["kind"] == "Job"]
    return found


def of_job(job: dict) -> Launch:
    """The launch of an indexed job: a process in each pod."""
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    [container] = pod["containers"]
    named = {variable["name"]: variable.get("value") for variable in container["env"]}
    assert spec["completionMode"] == "Indexed"
    assert spec["completions"] == spec["parallelism"] == int(named["JAX_NUM_PROCESSES"])
    assert container["command"][:2] == ["mevs", "train"]
    devices = spec["completions"] * container["resources"]["limits"]["nvidia.com/gpu"]
    return Launch(tuple(map(str, container["command"][2:])), devices, spec["completions"])


def refusals(text: str, at_once, out: Path) -> list[str]:
    """The sentences with which launches of a page are refused."""
    said = []
    for launch in launches(text):
        given = iter(launch.options)
        options = [option for option in given if option != "--out" or not next(given)]
        shape = ["--plan-devices", str(launch.devices), "--plan-processes", str(launch.processes), *MILLION]
        result = at_once("train", *options, "--plan", *shape, "--out", out)
        if result.returncode:
            said.append(refused(result))
    return said


def test_every_documented_launch_can_start(at_once, tmp_path, without_costs):
    text = SCALING.read_text()
    found = launches(text)
    shapes = {(launch.devices, launch.processes) for launch in found if "--distributed" in launch.options}
    assert shapes == {(8, 8), (64, 16), (2, 2), (32, 4)}  # Slurm, a v5e-64, by hand, GKE
    assert len(found) >= 8
    assert refusals(text, at_once, tmp_path / "run") == []


@pytest.mark.parametrize(
    ("right", "wrong", "count"),
    [
        (" --classifier.optimiser.batch-size 256", "", 2),
        ('--entropy.optimiser.batch-size, "256"', '--entropy.optimiser.batch-size, "100"', 1),
        ("--nodes=1", "--nodes=3", 0),
        ("64 devices\n", "a pod\n", 0),
    ],
)
def test_a_documented_launch_that_cannot_start_is_found(right, wrong, count, at_once, tmp_path, without_costs):
    text = SCALING.read_text()
    assert right in text
    text = text.replace(right, wrong)
    if count:
        assert len(refusals(text, at_once, tmp_path / "run")) == count
    else:  # it contradicts what is told above it, or nothing is told
        with pytest.raises(AssertionError):
            launches(text)


def test_a_documented_refusal_is_that_of_the_command(refuses, tmp_path):
    """A plan in the documentation that is shown with its refusal is refused so."""
    shown = re.findall(r"^    (mevs train .*--plan.*)\n    (mevs: .*)$", SCALING.read_text(), flags=re.M)
    assert shown
    for command, sentence in shown:
        assert refuses("train", *options_of(command.replace("RUN", str(tmp_path / "run")))) == sentence


def test_a_job_is_not_tried_again_after_what_would_come_again():
    """Kubernetes: exit codes 2 and 3 end the job; disruptions do not count; all other failures are tried again."""
    [block] = re.findall(r"```yaml\n(.*?)```", SCALING.read_text(), flags=re.S)
    service, job = yaml.safe_load_all(block)
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    fail, ignore = spec["podFailurePolicy"]["rules"]
    assert fail == {
        "action": "FailJob",
        "onExitCodes": {"containerName": pod["containers"][0]["name"], "operator": "In", "values": [2, 3]},
    }
    assert ignore == {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget", "status": "True"}]}
    assert pod["restartPolicy"] == "Never"  # which a pod failure policy needs
    assert spec["backoffLimit"] > 0
    assert service["metadata"]["name"] == pod["subdomain"] == "mevs"
