"""The rod against closed forms, boundary value problems and two independent engines.

``python -m benchmarks.validation`` measures every case and writes the figures and pictures of
docs/validation.md; the tests of tests/dlo_gym/rod/test_validation_*.py hold the same functions to
tolerances.
"""
