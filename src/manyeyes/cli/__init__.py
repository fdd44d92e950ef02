# SPDX-License-Identifier: Apache-2.0
"""What meets a person: the command line, its verbs, the viewer."""
