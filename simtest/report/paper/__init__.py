"""The page of the published protocol: the article's figures and statements, drawn and judged from a run's own rows.

Sweeps are recognised by the columns ``paper.*``; nothing hangs on an experiment's name.
"""
