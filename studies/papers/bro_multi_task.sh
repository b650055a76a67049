#!/bin/sh
# BRO (https://arxiv.org/abs/2405.16158), figure 19: one BRO Fast and one SAC for all of Meta-World's MT50, the task as
# a one-hot vector in the inputs, all networks twice as wide, three seeds each; all else as in its main experiments, so
# that SAC is the tuned one of table 5, two gradient steps for a step of all tasks, as BRO Fast.
# Substitutes for what the text leaves open: a million steps of each task, as in the main experiments, of which 2,500
# (BRO Fast) and 10,000 (SAC) are random, those experiments' numbers; the last million transitions of each task are
# kept, some 10 GB for MT50.
#   sh studies/papers/bro_multi_task.sh [MT50|MT10|DMC_DOGS|TASK [FURTHER ARGUMENTS OF examples/multi_task.py]]
#   sb3-sample study aggregate runs/bro_multi_task_MT50.csv
# AGENTS="sac", SEEDS="0 1" and PYTHON=... choose agents, seeds and interpreter. Interrupted and started again, each run
# goes on.
set -e
suite=${1:-MT50}
[ $# -eq 0 ] || shift
python=${PYTHON:-python}
folder=runs/bro_multi_task_$suite
for seed in ${SEEDS:-0 1 2}; do
    for agent in ${AGENTS:-bro_fast sac}; do
        case $agent in sac) random=10000 ;; *) random=2500 ;; esac
        "$python" "$(dirname "$0")/../../examples/multi_task.py" --agent "$agent" --tasks "$suite" \
            --random-steps "$random" --steps 1000000 --eval-every 50000 --seed "$seed" --folder "$folder/$agent" "$@"
    done
done
set --
for agent in ${AGENTS:-bro_fast sac}; do
    case $agent in sac) name="SAC" ;; *) name="BRO Fast" ;; esac
    set -- "$@" "$name $suite=$folder/$agent"
done
"$python" -m sb3_sample.cli study table "$@" -o "$folder.csv"
