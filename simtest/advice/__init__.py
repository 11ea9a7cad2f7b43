"""What a scope and its lights can reach, answered by renders of frames like theirs.

`scope` reads camera, lights and sensor; `organs` holds the surfaces and what is drawn of them; `plan` writes the
experiments; `break_points` computes by the laws where methods fail and plans the renders that confirm it; `figures`
reads the results; `advise` runs all of it, and `page` writes what was found.
"""
