"""Warnings about sweeps that are allowed: a torque that saturates early, a plant step too long."""

from sweeps.runner import warnings_of
from sweeps.spec.reading import parse


def test_warnings_say_how_much():
    stiff = parse('name = "a"\n[axes]\nK0 = [300.0]\nDenv = [10.0, 5000.0]', "f")
    lines = list(warnings_of(stiff))
    assert "K0*x0 reaches 2 times Fmax" in lines[0]
    # lambda = D/I = 500 1/s, less K/D which is a few 1/s: 5 time constants in 10 ms
    assert "dt = 0.01 s is 4." in lines[1] or "dt = 0.01 s is 5" in lines[1]
    assert "unstable" in lines[1]
    assert not list(warnings_of(parse('name = "a"\n[axes]\nK0 = [50.0, 100.0]', "f")))
