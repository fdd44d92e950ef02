# SPDX-License-Identifier: Apache-2.0
"""Published pose correctors, one per file, with the interface of the default corrector: correct(ego, other, prior).

Written from the papers, on landmarks. None of them states a covariance, so each gets that of its pairs.
"""
