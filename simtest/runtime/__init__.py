"""What every package stands on.

`files` writes atomically, `resources` finds shipped data, `seeds` holds the seed tree, `provenance` records versions
and hashes, `measuring` takes times and memory, `arrays` names the array types, `engines` runs tasks in parallel,
`lazy_names` loads a package's names at first use.
"""
