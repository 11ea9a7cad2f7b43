"""What to expect of a scope, before and after its pictures are taken: advice on a rig, and twins of real highlights."""
