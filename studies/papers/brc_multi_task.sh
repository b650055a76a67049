#!/bin/sh
# BRC (Nauman et al. 2025) on many tasks at once, as published: critics 4,096 wide, batch 1,024, two gradient steps for
# a step of all tasks, a million steps of each, of which 5,000 are random, all kept in the replay buffer, five seeds. In
# the published code one agent learns DMC's four dogs (DMC_DOGS), one its three humanoids (DMC_HUMANOIDS) and one
# Meta-World's 50 tasks (MT50). Published means over the seven dog and humanoid tasks at 100k, 200k, 500k and 1M steps
# of each: 63, 193, 494, 680. A gradient step is some 1,700 GFLOP: days on a GPU for each seed. The replay buffers take
# some 4, 1 and 10 GB of memory. Not as published: on Meta-World the tasks are v3 in the library's order, each episode has
# a new goal and start (the authors' environments keep those of their construction), and MT10 is no study of the paper's.
#   sh studies/papers/brc_multi_task.sh DMC_DOGS|DMC_HUMANOIDS|MT50|MT10 [FURTHER ARGUMENTS OF examples/multi_task.py]
# On a CPU the same with critics 512 wide, evaluated at 0, 5,000 and 10,000 steps of each task: 19,000 gradient steps of
# 28 GFLOP, at least 1.6 hours a seed on a core of 90 GFLOP/s:
#   python examples/multi_task.py --tasks MT10 --seed 0 --folder runs/brc_mt10
# SEEDS="0 1" and PYTHON=... choose seeds and interpreter. Interrupted and started again, each run goes on.
set -e
suite=${1:?"name DMC_DOGS, DMC_HUMANOIDS, MT50, MT10 or a task: sh studies/papers/brc_multi_task.sh MT50"}
shift
python=${PYTHON:-python}
for seed in ${SEEDS:-0 1 2 3 4}; do
    "$python" "$(dirname "$0")/../../examples/multi_task.py" --tasks "$suite" --critic-width 4096 --random-steps 5000 \
        --steps 1000000 --eval-every 50000 --seed "$seed" --folder "runs/brc_$suite" "$@"
done
"$python" -m sb3_sample.cli study table "BRC $suite=runs/brc_$suite" -o "runs/brc_$suite.csv"
