"""Poses of a labelling by expectation–maximisation: where it begins, its loop, its noise, how it comes to rest."""
