"""What the tests expect of their process."""

import multiprocessing
import signal

import torch

# The tests' networks are tiny, and two runs are compared bit by bit.
torch.set_num_threads(1)
# A shell's background job ignores it, and so would all that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Programs that tests start and kill are forked off a process that has imported everything. It must be told so before
# whatever test is the first to start it.
if "forkserver" in multiprocessing.get_all_start_methods():
    multiprocessing.set_forkserver_preload(["tests.saving.program"])
