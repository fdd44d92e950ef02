# SPDX-License-Identifier: Apache-2.0
"""The engine of all studies: stored results, jobs, reports; and methods under conditions on a recording."""
