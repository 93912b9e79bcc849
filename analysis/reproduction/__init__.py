"""The paper's claims, each reproduced or refuted with figures and a verdict: `analysis paper`.

Start with `reproduce`; `claims` holds the verdicts.
"""
