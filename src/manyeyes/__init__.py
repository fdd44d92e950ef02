# SPDX-License-Identifier: Apache-2.0
"""manyeyes: many agents, each with its own eyes and few bytes to say what it sees."""

__version__ = "0.1.0"
