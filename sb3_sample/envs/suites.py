"""
The papers' lists of tasks, as ids of this package.

Where a paper's table differs from today's libraries:

* BRO's table 4 gives the humanoid 24 actions; ``dm_control`` has 21 (and the 67 observations of the table).
* BRO's table 4 lists Meta-World's pick-place; the published curves of BRO have pick-place-wall instead (those of
  TD-MPC2 have both). The lists follow the table.
* The papers ran Meta-World's v2 tasks; these are v3, the same tasks and observation on newer bindings of MuJoCo.
* MBMA's tables abbreviate: "ball catch" is ball_in_cup-catch, "cart 2-poles" cartpole-two_poles, "finger turn"
  finger-turn_easy (as its figure 3 says), "point easy" point_mass-easy. Its agents act with ``action_repeat=4``.
"""

from sb3_sample.envs.registration import PACKAGE


def _dmc(*tasks: str) -> tuple[str, ...]:
    return tuple(f"dmc/{task}-v0" for task in tasks)


def _metaworld(*tasks: str) -> tuple[str, ...]:
    return tuple(f"metaworld/{task}-v3" for task in tasks)


def _myosuite(*tasks: str) -> tuple[str, ...]:
    return tuple(f"myosuite/{task}-v0" for task in tasks)


#: BRO, table 4: DeepMind Control (15).
BRO_DMC = _dmc(
    "acrobot-swingup",
    "cheetah-run",
    "dog-run",
    "dog-trot",
    "dog-stand",
    "dog-walk",
    "finger-turn_hard",
    "fish-swim",
    "hopper-hop",
    "humanoid-run",
    "humanoid-stand",
    "humanoid-walk",
    "pendulum-swingup",
    "quadruped-run",
    "walker-run",
)
#: BRO, table 4: Meta-World (15).
BRO_METAWORLD = _metaworld(
    "basketball",
    "assembly",
    "button-press",
    "coffee-pull",
    "coffee-push",
    "disassemble",
    "hammer",
    "hand-insert",
    "push",
    "reach",
    "stick-pull",
    "sweep",
    "lever-pull",
    "pick-place",
    "push-back",
)
#: BRO, table 4: MyoSuite (10).
BRO_MYOSUITE = _myosuite(
    "key-turn",
    "key-turn-hard",
    "obj-hold",
    "obj-hold-hard",
    "pen-twirl",
    "pen-twirl-hard",
    "pose",
    "pose-hard",
    "reach",
    "reach-hard",
)
#: BRO's 40 tasks.
BRO = BRO_DMC + BRO_METAWORLD + BRO_MYOSUITE
#: BRO, table 3: the ten tasks of its ablations.
BRO_ABLATION = _dmc("acrobot-swingup", "dog-trot", "hopper-hop", "humanoid-run", "humanoid-walk") + _metaworld(
    "assembly", "coffee-push", "hand-insert", "push", "stick-pull"
)

#: The regularization study (https://arxiv.org/abs/2403.00514), section 3: DeepMind Control (7).
REGULARIZATION_DMC = _dmc(
    "acrobot-swingup",
    "hopper-hop",
    "humanoid-walk",
    "humanoid-run",
    "dog-trot",
    "dog-run",
    "quadruped-run",
)
#: The regularization study, section 3: Meta-World (7).
REGULARIZATION_METAWORLD = _metaworld(
    "hammer",
    "push",
    "sweep",
    "coffee-push",
    "stick-pull",
    "reach",
    "hand-insert",
)
#: The regularization study's 14 tasks.
REGULARIZATION = REGULARIZATION_DMC + REGULARIZATION_METAWORLD

#: DAC: the domains that it names. Its 30 tasks are in a table 3 that the dissertation's text of the paper does not
#: contain, and no other list of them was found there: the text says that they come from DeepMind Control, Meta-World
#: and MyoSuite, and names only "the dog and humanoid domains" (its figure 9, 3M steps against TD-MPC). This list has
#: the tasks that can be recovered: the seven locomotion tasks of those two domains, not the 30.
DAC_NAMED = _dmc("dog-stand", "dog-walk", "dog-trot", "dog-run", "humanoid-stand", "humanoid-walk", "humanoid-run")

#: VPL-SAC, table 3: DeepMind Control (10).
VPL_DMC = _dmc(
    "acrobot-swingup",
    "fish-swim",
    "hopper-hop",
    "hopper-stand",
    "humanoid-run",
    "humanoid-stand",
    "humanoid-walk",
    "quadruped-run",
    "swimmer-swimmer6",
    "walker-run",
)
#: VPL-SAC, table 3: Meta-World (10).
VPL_METAWORLD = _metaworld(
    "assembly",
    "box-close",
    "button-press",
    "coffee-pull",
    "coffee-push",
    "drawer-open",
    "hammer",
    "push",
    "stick-pull",
    "sweep",
)
#: VPL-SAC's 20 tasks.
VPL = VPL_DMC + VPL_METAWORLD
#: VPL-SAC, table 4: the four tasks of its additional experiments.
VPL_ADDITIONAL = _dmc("acrobot-swingup", "hopper-hop", "humanoid-walk", "quadruped-run")

#: MBMA, table 3: 14 tasks, 1M environment steps, action repeat 4.
MBMA = _dmc(
    "acrobot-swingup",
    "ball_in_cup-catch",
    "cartpole-swingup",
    "cartpole-two_poles",
    "cartpole-three_poles",
    "cheetah-run",
    "finger-spin",
    "finger-turn_easy",
    "point_mass-easy",
    "reacher-easy",
    "reacher-hard",
    "walker-stand",
    "walker-walk",
    "walker-run",
)
#: MBMA, table 4: four harder tasks, 3M (quadruped) and 6M (humanoid) environment steps, action repeat 4.
MBMA_HARD = _dmc("quadruped-walk", "quadruped-run", "humanoid-stand", "humanoid-walk")

#: DeepMind Control's dogs and its humanoids; BRC's published code learns each of the two with one agent.
DMC_DOGS = _dmc("dog-stand", "dog-walk", "dog-trot", "dog-run")
DMC_HUMANOIDS = _dmc("humanoid-stand", "humanoid-walk", "humanoid-run")
#: The seven of both, over which the papers after BRO average.
DMC_HARD = DMC_DOGS + DMC_HUMANOIDS
#: Meta-World's MT10 and MT50, tasks for one agent, in the order of the library (``metaworld.env_dict``): a task's
#: position is its number.
MT10 = _metaworld(
    "reach",
    "push",
    "pick-place",
    "door-open",
    "drawer-open",
    "drawer-close",
    "button-press-topdown",
    "peg-insert-side",
    "window-open",
    "window-close",
)
MT50 = _metaworld(
    "assembly",
    "basketball",
    "bin-picking",
    "box-close",
    "button-press-topdown",
    "button-press-topdown-wall",
    "button-press",
    "button-press-wall",
    "coffee-button",
    "coffee-pull",
    "coffee-push",
    "dial-turn",
    "disassemble",
    "door-close",
    "door-lock",
    "door-open",
    "door-unlock",
    "hand-insert",
    "drawer-close",
    "drawer-open",
    "faucet-open",
    "faucet-close",
    "hammer",
    "handle-press-side",
    "handle-press",
    "handle-pull-side",
    "handle-pull",
    "lever-pull",
    "pick-place-wall",
    "pick-out-of-hole",
    "pick-place",
    "plate-slide",
    "plate-slide-side",
    "plate-slide-back",
    "plate-slide-back-side",
    "peg-insert-side",
    "peg-unplug-side",
    "soccer",
    "stick-push",
    "stick-pull",
    "push",
    "push-wall",
    "push-back",
    "reach",
    "reach-wall",
    "shelf-place",
    "sweep-into",
    "sweep",
    "window-open",
    "window-close",
)

#: The lists by their names.
SUITES: dict[str, tuple[str, ...]] = {
    name: tasks for name, tasks in list(globals().items()) if isinstance(tasks, tuple) and not name.startswith("_")
}

# The published curves of Gymnasium's tasks are of v4; today's version is v5.
_GYMNASIUM = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "Walker2d")
#: Prefixes of HumanoidBench's ids. This package has none of them; whoever has installed HumanoidBench finds the curves.
_HUMANOIDBENCH = ("h1-", "h1hand-")


def published_key(env_id: str) -> tuple[str, str]:
    """
    The names under which the published curves list an environment.

    :param env_id: An id, e.g. ``"metaworld/push-v3"``, ``"myosuite/key-turn-v0"``, ``"dmc/cheetah-run-v0"``,
        ``"HalfCheetah-v5"`` or ``"h1-balance_hard-v0"``; the prefix ``sb3_sample:`` may precede it.
    :return: Suite and task: ``("metaworld", "push")``, ``("myosuite", "myo-key-turn")``, ``("dmc", "cheetah-run")``,
        ``("gymnasium", "HalfCheetah-v4")``, ``("humanoidbench", "h1-balance-hard-v0")``. Not every task has curves.
    :raises ValueError: The id is of none of these suites.
    """
    name, separator, version = env_id.removeprefix(f"{PACKAGE}:").rpartition("-v")
    if separator and version.isdigit():
        suite, slash, task = name.partition("/")
        if slash and suite in ("dmc", "metaworld"):
            return suite, task
        if slash and suite == "myosuite":
            return suite, f"myo-{task}"
        if name in _GYMNASIUM:
            return "gymnasium", f"{name}-v4"
        if name.startswith(_HUMANOIDBENCH):
            return "humanoidbench", f"{name.replace('_', '-')}-v{version}"
    raise ValueError(
        "env_id must be a versioned id of dmc/, metaworld/ or myosuite/, of HumanoidBench (h1-..., h1hand-...), or of "
        f"{', '.join(_GYMNASIUM)}, got {env_id!r}"
    )


def published_id(suite: str, task: str) -> str:
    """
    The id of today's environment, the inverse of :func:`published_key`. Meta-World's curves are of v2; this package has
    v3.

    :param suite: of the published curves
    :param task: likewise
    :return: id, e.g. ``"metaworld/push-v3"``; :func:`published_key` of it is the suite and the task
    """
    if suite in ("dmc", "metaworld", "myosuite"):
        return f"{suite}/{task.removeprefix('myo-')}-v{3 if suite == 'metaworld' else 0}"
    return task
