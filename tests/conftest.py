# SPDX-License-Identifier: Apache-2.0
"""One torch thread for every test; hypothesis draws the same examples every time."""

import hypothesis
import torch

torch.set_num_threads(1)
hypothesis.settings.register_profile("manyeyes", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("manyeyes")
