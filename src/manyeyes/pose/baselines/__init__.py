# SPDX-License-Identifier: Apache-2.0
"""Published ways to correct a pose, one a file, behind the interface of the default corrector: correct(ego, other,
claimed).

Written from the papers and specs/pose.md 2, on landmarks. None of them states a covariance, so each is given that of
its pairs.
"""
