"""What the tests expect of their process."""

import signal

import torch

# The tests' networks are tiny, and two runs are compared bit by bit.
torch.set_num_threads(1)
# A shell's background job ignores it, and so would all that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
