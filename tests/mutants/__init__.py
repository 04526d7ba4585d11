"""Faults put into the code on purpose, to see whether a test fails with each: `make mutants` (DeMillo, Lipton &
Sayward, *Computer* 11, 1978). `named` holds those that once survived or must never; `sites` draws others at random."""
