"""One thread for torch: the tests' networks are tiny, and two runs are compared bit by bit."""

import torch

torch.set_num_threads(1)
