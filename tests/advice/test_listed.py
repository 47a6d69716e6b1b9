"""Every message that gives advice is followed by a test, or stands here with the reason why not."""

from __future__ import annotations

import ast
import inspect
import re
import tomllib

import pytest

from mevs_jax.cli.commands import COMMANDS
from tests.advice import test_calls, test_commands, test_stages
from tests.advice.listing import COMMAND, EXTRA, OPTION, ROOT, advice, options

OF_OTHERS = {"--system-site-packages"}
ELSEWHERE = {
    "advice/test_commands.py::test_a_run_names_the_command_that_makes_what_is_lost": [
        "the run in … has no trained system yet; finish it with: mevs run --out …",
        "… cannot be read (…); make it with: mevs eval --out …",
    ],
    "eval/test_stale.py::test_stale_metrics_are_refused_by_every_stage_that_shows_them": [
        "mevs eval --out …",
    ],
    "eval/test_stale.py::test_tables_of_other_networks_are_refused_where_they_are_only_read": [
        "make it again with: mevs eval --out …",
    ],
    "data_pipeline/test_advice.py::test_another_backend_can_be_used_where_one_cannot_begin": [
        "use --dataset.capture.backend raycast",
    ],
    "data_pipeline/test_advice.py::test_strangers_are_added_as_advised": [
        "give --data others and add --dataset.more strangers",
    ],
    "data_pipeline/test_advice.py::test_damaged_shards_are_made_again_once_they_are_deleted": [
        "…; delete …, and make it again with: mevs data --out …",
    ],
    "data_pipeline/test_advice.py::test_a_run_that_did_not_finish_goes_on_with_the_same_settings_alone": [
        "give the same again to go on with it, delete the folder, or choose another --out",
    ],
    "data_pipeline/test_advice.py::test_a_missing_data_set_names_the_command_that_makes_it": [
        "no shards in …; create them with: mevs data --out …",
    ],
    "train/running/test_processes.py::test_two_processes_train_as_one_does": [
        "set JAX_COORDINATOR_ADDRESS=host:port, JAX_NUM_PROCESSES and JAX_PROCESS_ID for each",
    ],
    "data_pipeline/scene/test_scene.py::test_without_ground_or_objects_there_is_one_sentence_whose_advice_works": [
        "nothing stands on the ground",
        "give its height along --upward, --floor H",
        "says which way is up; give --upward X Y Z",
    ],
    "train/test_training.py::test_what_is_not_finite_is_not_saved": [
        "…; to train again, lower … (… in this run), and delete … or choose another --out",
    ],
    "train/tasks/test_own_encoder.py::test_it_is_trained_and_named_by_its_source": [
        "with …:… as it was before it was edited; restore that file",
    ],
    "train/tasks/test_encoders.py::test_what_does_not_fit_is_refused": [
        "--classifier.images normals have three channels; give --classifier.network.channels 3 too",
        "--classifier.frozen is for this project's own networks, not for …; leave it out",
        "--encoder …: …; choose another --dataset.capture.resolution",
    ],
    "mevs_jax/models/test_encoders.py::test_the_packages_weights_are_named_with_their_licence": [
        "--encoder … starts from one file of --pretrained, got …; leave the others out",
    ],
    "train/running/test_checkpoints.py::test_a_damaged_training_ends_with_the_same_weights": [
        "or delete this folder first",
    ],
    "cli/test_tools.py::test_a_system_meets_other_objects": [
        "if one only has another name, say so: --names FOLDER=CLASS",
    ],
    "eval/numbers/test_trainings.py::test_trainings_on_other_objects_are_not_averaged": [
        "the trainings were evaluated on different objects; evaluate them again: mevs eval",
    ],
}
"""Messages that other tests follow, by these."""
_DIVERGED = (
    "what to do is that of a training that diverged, which is followed; to get here, numbers would have to be planted"
)
APART = {
    "usage: mevs COMMAND": "help; each command of it is one (`COMMANDS`)",
    "1, or 3 with --preset best": "help",
    "Settings (listed by --help-all)": "help",
    "Agents by the default policy, by `mevs check transfer`": "a title of a card",
    "mevs check reality": "names a job in its lock",
    "mevs sweep --adopt": "names a job in its lock",
    "mevs export": "names a job in its lock",
    "the list of --dataset.split": "names what has changed",
    "--sweep.grid …": "says where a number is that is out of its range",
    "--sweep.list …, configuration …": "says where a number is that is out of its range",
    "--policy …": "says which policy",
    "--archive … cannot be read: …": "says what is wrong with a file, and no more",
    "class … has … object, and --dataset.split needs 2 or more": "the first half of a sentence, whose advice is followed",
    "--dataset.split 1: each object is for training": "a note of what a number means",
    "XLA has no devices for --target … (…)": "gives XLA's reason, and no more",
    "a line to /etc/hosts": "changes the machine",
    "the file system is read-only": "mounts a file system",
    "change its permissions, or choose another --out": "tests run as root, to whom every folder is open",
    "… cannot be read: …; choose another --data": "tests run as root, to whom every folder is open",
    "a temperature of the recogniser's fusion is not finite": _DIVERGED,
    "every trial of the study in … diverged": _DIVERGED,
    "every member of the sweep in … diverged": _DIVERGED,
    "the … diverged from seed …": _DIVERGED,
    "as happens when a training diverged": _DIVERGED,
    "is not finite, and the outputs of the network in … reach": _DIVERGED,
    "set --learned.rotation-epochs 0": "0 is the default, by which all tests of studies run",
    "The ablation with PointNet++ embeddings is left out": "a note; its command is one of those that are followed",
}
"""Strings with options or commands that give no advice, or advice that no test can follow, and why."""
PAGES = ("eval/report/", "eval/learned/page.py", "eval/thesis/page.py")
"""Commands that pages show, which `test_what_a_page_says_to_do_next_can_be_done` runs."""


def followed() -> list[str]:
    rows = [*test_commands.FOLLOWED, *test_stages.FOLLOWED, *test_stages.SPOILED]
    calls = [
        node.value for node in ast.walk(ast.parse(inspect.getsource(test_calls))) if isinstance(node, ast.Constant)
    ]
    return [row[0] for row in rows] + [told for told in calls if isinstance(told, str) and told.count(" ") > 3]


def test_every_advice_is_followed():
    texts = [text for where, text in advice() if not where.startswith(PAGES) and not EXTRA.search(text)]
    elsewhere = [told for messages in ELSEWHERE.values() for told in messages]
    known = [*followed(), *elsewhere, *APART]
    assert [text for text in texts if not any(told in text for told in known)] == []
    every = [text for _, text in advice()]
    assert [told for told in (*elsewhere, *APART) if not any(told in text for text in every)] == []


@pytest.mark.parametrize("test", ELSEWHERE)
def test_tests_that_follow_advice_exist(test):
    path, _, name = test.partition("::")
    assert f"def {name}(" in (ROOT / "tests" / path).read_text()


def test_options_that_messages_name_exist():
    wrong = [
        (where, name) for where, text in advice() for name in OPTION.findall(text) if name not in options() | OF_OTHERS
    ]
    assert wrong == []


def test_commands_that_messages_name_exist():
    wrong = [(where, name) for where, text in advice() for name in COMMAND.findall(text)
             if not any(name == known or name.split()[0] == known for known in COMMANDS)]  # fmt: skip
    assert wrong == []


def test_extras_that_messages_name_hold_the_package_that_is_missing():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = [(extra, text) for _, text in advice() for extra in EXTRA.findall(text)]
    assert len(named) > 8
    for extra, text in named:
        packages = [re.split(r"[>=;\[]", one)[0] for one in extras[extra]]
        known = any(re.search(one.replace("-", "[- ]"), text, re.IGNORECASE) for one in packages if one != "mevs-jax")
        assert known or "package …" in text, text
