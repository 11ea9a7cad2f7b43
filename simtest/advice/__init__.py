"""What to expect of a scope: advice on a rig before its pictures are taken, and twins of the highlights of a picture.

`scope` reads camera, lights and sensor; `tissue` holds the surfaces and what is drawn of them; `plan` writes the
experiment; `answers` reads the results; `advise` is the whole. `twin/` renders a picture's highlights again.
"""
