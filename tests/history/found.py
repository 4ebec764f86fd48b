"""The defects that histories have found, each as the steps that show it: the fixed set.

The generator changes, and with it what a seed means, so the steps are here and not the seeds. All
of them are mended; docs/history.md tells of each.
"""

from tests.history.steps import LOOK, Step

_GIVEN_UP_MS = 6000
"""Until systemd has used up the restarts, on an idle machine; before that it is another history."""
_BEGIN = (Step("start"), Step(LOOK))

FOUND: dict[str, tuple[Step, ...]] = {
    # Seed 14: `list` no longer said Failed, since the start had had systemd forget it.
    "a start of a failed dataflow is refused": (
        *_BEGIN,
        Step("project-deleted"),
        Step("systemctl-restart"),
        Step("start", pause_ms=_GIVEN_UP_MS),
        Step(LOOK),
    ),
    # Seed 14: `list --all` said Stopped, `why` Failed, once systemd had forgotten it.
    "a restart never began": (
        *_BEGIN,
        Step("project-deleted"),
        Step("systemctl-restart"),
        Step("reset", pause_ms=_GIVEN_UP_MS),
        Step(LOOK),
    ),
    # Seed 4: a number of Python's instead of a reason.
    "set while it restarts": (*_BEGIN, Step("kill-runner"), Step("set"), Step(LOOK)),
    # Seeds 203, 3007 and 3009: `list` said Stopped, `why` Failed, or the other way round.
    "a stop calls off a restart": (
        *_BEGIN,
        Step("kill-unit"),
        Step("stop", pause_ms=300),
        Step(LOOK),
        Step("start"),
        Step("kill-coordinator"),
        Step("stop", pause_ms=700),
        Step(LOOK),
    ),
    # Seeds 217 and 306: a drop-in for the next dataflow of that name, and words of Python's.
    "/run is full": (*_BEGIN, Step("run-full"), Step("set"), Step("restart"), Step(LOOK)),
    # Seed 217: the trial took two minutes. Seed 1002: a restart by name ran another project. Seed
    # 15 of 24 steps: the unit file stayed after all had ended.
    "a broken release, and none": (
        Step("deploy"),
        Step(LOOK),
        Step("deploy-broken"),
        Step(LOOK),
        Step("disable"),
        Step("systemctl-stop"),
        Step("restart"),
        Step(LOOK),
    ),
    # Seed 4020: a failed unit stayed after the end. Seed 4048: a number of Python's.
    "the gateway and the coordinator are killed": (
        *_BEGIN,
        Step("kill-coordinator"),
        Step("node-restart", is_joined=True),
        Step("kill-gateway"),
        Step(LOOK),
        Step("kill-gateway"),
    ),
    # By hand, before: the second restart was counted, and the third was the last.
    "a hand restarts, stops and restarts": (
        *_BEGIN,
        Step("node-restart-sink"),
        Step("node-restart-sink"),
        Step("node-restart"),
        Step(LOOK),
        Step("node-stop"),
        Step(LOOK),
        Step("node-stop-source"),
        Step(LOOK),
        Step("node-restart-sink"),
        Step("node-restart"),
        Step(LOOK),
        Step("kill-sink"),
        Step(LOOK),
    ),
    # Seed 329: one restart was counted, and none listed.
    "a node is stopped while it crashes": (
        *_BEGIN,
        Step("kill-sink"),
        Step("node-stop", is_joined=True),
        Step(LOOK),
        Step("kill-sink"),
        Step("node-stop", pause_ms=100),
        Step(LOOK),
    ),
}
