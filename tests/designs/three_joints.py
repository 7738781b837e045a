"""The file of a small arm, for several test files."""

ROBOT = """\
convention: dh
units: {length: m, angle: deg}
joints:
  - {a: 0.1, alpha: -90, d: 0.4, theta: 0, limits: [-150, 150]}
  - {a: 0.4, alpha: 30, d: 0.1, theta: 0, limits: [-150, 150]}
  - {a: 0.3, alpha: 80, d: 0.2, theta: 0, limits: [-150, 150]}
tool: {x: 0.05, y: 0.02, z: 0.1}
tolerance: {a: 0.001, d: 0.001, alpha: 0.05, theta: 0.1}
"""
