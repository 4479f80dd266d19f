"""Actuators with a controller or a motor of their own, and where MuJoCo keeps the numbers of their targets."""

MOTORS = """<pid name="pid" joint="hinge2" input="pos" kp="2" kv=".1" ki="3"/>
  <dcmotor name="drive" joint="hinge2" resistance="2" motorconst=".3" input="pos" controller="2 3 .1 0 0 6"
    inductance="0 .01"/>"""

# (target, value, unit, field, slot)
CASES = [
    ("actuator:pid.ki", 4.0, "N m/(rad s)", "gainprm", 0),
    ("actuator:drive.resistance", 3.0, "Ohm", "gainprm", 0),
    ("actuator:drive.motor_constant", 0.4, "N m/A", "gainprm", 1),
    ("actuator:drive.kp", 4.0, "N m/rad", "gainprm", 4),
    ("actuator:drive.ki", 4.0, "N m/(rad s)", "gainprm", 5),
    ("actuator:drive.kv", 0.2, "N m s/rad", "gainprm", 6),
    ("actuator:drive.voltage_limit", 4.0, "V", "gainprm", 7),
    ("actuator:drive.lag", 0.02, "s", "dynprm", 0),
]
