"""What every package stands on.

`files` writes atomically and refuses what is too large, `locks` keeps a folder to one run, `resources` finds shipped
data and registered objects, `boundary` says what is wrong, `arrays` names the array types and keeps arrays, `processes`
runs tasks in parallel, `seeds` holds the seed tree, `provenance` records versions and hashes, `statistics` makes
intervals, `fitted` gives the numbers that were fitted to data, `lazy_names` loads a package's names at first use.
"""
