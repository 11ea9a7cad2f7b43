"""What to expect of a scope: advice on a rig before its pictures are taken, and twins of the highlights of a picture.

`scope` reads camera, lights and sensor; `organs` holds the surfaces and what is drawn of them; `plan` writes the
experiment; `break_points` computes by the laws where methods fail; `figures`
reads the results; `advise` runs all of it, and `page` writes what was found. `twin/` renders a picture's highlights
again.
"""
