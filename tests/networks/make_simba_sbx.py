"""
Make ``simba_sbx.npz``: parameters, inputs, outputs and gradients of SBX's SimBa networks.

    pip install "sbx-rl==0.28.0" "flax==0.12.8" && python tests/networks/make_simba_sbx.py tests/networks/simba_sbx.npz

JAX's random numbers are the same on every machine, sums only to rounding. Gradients are those of the sum of the outputs
times ``weight...``.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from sbx.common.policies import SimbaSquashedGaussianActor, SimbaVectorCritic

N_ROWS, OBSERVATION_SIZE, N_ACTIONS = 7, 5, 2


def moved(parameters, key):
    """Initial parameters, with biases, scales and the kernel of the log standard deviation (Dense_2) moved."""
    flat = flatten_dict(parameters, sep="/")
    for name, value in flat.items():
        key, own = jax.random.split(key)
        if name.endswith("bias"):
            flat[name] = value + 0.3 * jax.random.normal(own, value.shape)
        elif name.endswith("scale"):
            flat[name] = value * (1 + 0.2 * jax.random.normal(own, value.shape))
        elif name.startswith("Dense_2"):
            flat[name] = 0.5 * value
    return unflatten_dict(flat, sep="/")


def recorded(prefix, parameters, gradients):
    named = {"parameter": parameters, "gradient": gradients}
    return {f"{prefix}/{of}/{name}": v for of, tree in named.items() for name, v in flatten_dict(tree, sep="/").items()}


def main(path: str) -> None:
    keys = iter(jax.random.split(jax.random.key(0), 9))
    observations = jax.random.normal(next(keys), (N_ROWS, OBSERVATION_SIZE))
    actions = jax.random.uniform(next(keys), (N_ROWS, N_ACTIONS), minval=-1, maxval=1)
    found = {"observations": observations, "actions": actions}

    critic = SimbaVectorCritic(net_arch=[12, 12], n_critics=2)
    parameters = moved(critic.init(next(keys), observations, actions)["params"], next(keys))
    output = critic.apply({"params": parameters}, observations, actions)
    weight = jax.random.normal(next(keys), output.shape)
    gradients = jax.grad(lambda p: (critic.apply({"params": p}, observations, actions) * weight).sum())(parameters)
    found |= {"critic/output": output, "critic/weight": weight, **recorded("critic", parameters, gradients)}

    actor = SimbaSquashedGaussianActor(net_arch=[8], action_dim=N_ACTIONS)

    def numbers(p):
        distribution = actor.apply({"params": p}, observations).distribution
        return distribution.loc, jnp.log(distribution.scale.diag_part())

    parameters = moved(actor.init(next(keys), observations)["params"], next(keys))
    mean, log_std = numbers(parameters)
    weights = jax.random.normal(next(keys), (2, *mean.shape))
    gradients = jax.grad(lambda p: sum((w * x).sum() for w, x in zip(weights, numbers(p), strict=True)))(parameters)
    found |= {"actor/mean": mean, "actor/log_std": log_std, **recorded("actor", parameters, gradients)}
    found |= {"actor/weight_mean": weights[0], "actor/weight_log_std": weights[1]}
    np.savez_compressed(path, **{name: np.asarray(value, np.float32) for name, value in found.items()})


if __name__ == "__main__":
    main(*sys.argv[1:])
