"""Tests and studies: a package, since dartpy installs one of the same name."""
