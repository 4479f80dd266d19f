"""The words and units that names of columns are made of, in English and German, by what they say."""

from __future__ import annotations

GREEK = str.maketrans(
    {"θ": "theta", "τ": "tau", "ω": "omega", "φ": "phi", "ϕ": "phi", "α": "alpha", "β": "beta", "ψ": "psi", "°": "deg"}
)
ANGLES = {"angle", "angles", "theta", "phi", "alpha", "beta", "gamma", "psi", "th", "ang", "rotation", "heading"}
ANGLES |= {"winkel"}
LENGTHS = {"x", "y", "z", "displacement", "disp", "distance", "stroke", "travel", "extension", "height"}
PLACES = {
    "qm", "position", "positions", "pos", "q", "qpos", "enc", "encoder", "joint_pos", "actual", "present", "s", "p",
}  # fmt: skip
PLACES |= {"lage", "stellung"}
POSITIONS = ANGLES | LENGTHS | PLACES
ALONG, ABOUT = {"vx", "vy", "vz"}, {"wx", "wy", "wz", "gx", "gy", "gz"}  # velocities of a body
PUSHED = {"ax", "ay", "az"}  # accelerations of a body
OF_BODIES = ALONG | ABOUT | PUSHED
"""Words with an axis, of velocities and accelerations."""
GYROS = {"gyro", "gyros", "gyroscope", "omega"}
SPEEDS = {"velocity", "velocities", "vel", "speed", "w", "qvel", "rate", "v", "xv", "av"} | {
    "angvel", "drehzahl", "drehz", "geschwindigkeit",
} | GYROS | ALONG | ABOUT  # fmt: skip
ACCELERATIONS = PUSHED | {"acceleration", "accelerations", "acc", "accel", "qacc", "ddq", "qdd", "ddot"} | {
    "accelerometer",
}  # fmt: skip
TORQUES = {"tau", "torque", "torques", "effort", "efforts", "force", "forces", "trq", "f", "moment", "load", "thrust"}
TORQUES |= {"vir", "drehmoment", "kraft"}
COMMANDS = {"cmd", "command", "commands", "commanded", "u", "ctrl", "control", "controls", "action", "actions"} | {
    "input", "drive", "applied", "a",
}  # fmt: skip
DUTIES = {"pwm", "duty", "dutycycle", "throttle", "rcou", "pulse", "pulsewidth", "esc"}
PULSED = {"motor", "rotor", "servo", "prop", "thruster"}  # in microseconds
SUPPLIES = {"battery", "batt", "vbat", "vbatt", "supply", "vbus", "vdc", "vcc", "vin"}
DESIRED = {"des", "desired", "ref", "reference", "setpoint", "sp", "set", "target", "goal", "demand", "wanted"} | {
    "requested", "dem", "soll", "sollwert",
}  # fmt: skip
MEASURED = {
    "meas",
    "measured",
    "actual",
    "act",
    "present",
    "est",
    "estimated",
    "observed",
    "observation",
    "filtered",
    "sens",
    "ist",
    "istwert",
}
CURRENTS = {"current", "currents", "amps", "ampere", "cur", "iq", "i", "strom"}
VOLTAGES = {"voltage", "voltages", "volt", "volts", "spannung"}
TIMES = {"time", "t", "timestamp", "timestamps", "stamp", "clock", "elapsed", "seconds", "secs", "millis"} | {
    "micros", "nanos", "tick", "ticks", "timestep", "sec", "zeit",
}  # fmt: skip
EPISODES = {"episode", "trial", "rollout", "demo", "toss", "experiment", "ep", "traj", "trajectory"}
LETTERS = {"a", "f", "i", "n", "u", "v"}
"""Words of one letter, of commands, currents and units, that may also be a joint's: A1, axisA."""
OTHERS = {"temp", "temperature", "flag", "error", "err", "status", "mode", "index", "frame", "id", "reward"} | {
    "done", "task", "count", "seq", "step", "contact", "success", "residual", "power", "energy", "noise",
    "humidity", "pressure", "rssi", "sonar", "lidar", "ultrasonic", "fault", "warning", "health",
}  # fmt: skip
CELLS = {"cell", "cells"}  # of a battery: their voltages drive nothing
TURNS = {"cos", "sin", "cosine", "sine"}  # of an angle, as a resolver tells it
SIDES = {"left", "right", "front", "rear", "back", "hind", "fore", "middle", "mid", "l", "r"}
SIDES |= {a + b for a in "frhbm" for b in "lr"} | {a + b for a in "lr" for b in "frhbm"}
"""Words of a name that only say on which side, or at which leg, something is."""
UNITS = {
    "rad": "rad", "rads": "rad", "radian": "rad", "radians": "rad", "deg": "deg", "degs": "deg", "degree": "deg",
    "degrees": "deg", "mrad": "mrad", "rev": "rev", "revs": "rev", "turns": "rev", "rpm": "rpm", "dps": "deg/s",
    "radps": "rad/s", "degps": "deg/s", "mps": "m/s", "mmps": "mm/s", "rps": "rev/s", "mm": "mm", "cm": "cm",
    "um": "um", "meter": "m", "meters": "m", "metre": "m", "nm": "N m", "mnm": "mN m", "newton": "N", "newtons": "N",
    "mn": "mN", "kn": "kN", "volt": "V", "volts": "V", "mv": "mV", "amp": "A", "amps": "A", "ma": "mA", "ms": "ms",
    "msec": "ms", "millis": "ms", "us": "us", "usec": "us", "micros": "us", "ns": "ns", "nsec": "ns", "nanos": "ns",
    "sec": "s", "secs": "s", "seconds": "s", "pct": "%", "percent": "%", "m": "m", "n": "N", "v": "V", "a": "A",
    "s": "s",
}  # fmt: skip
OF_NO_JOINT = {"bar": "bar", "mbar": "mbar", "pa": "Pa", "kpa": "kPa", "mpa": "MPa", "kg": "kg"}
"""Units of pressures and of weights; psi is an angle as well."""
UNITS |= OF_NO_JOINT
RATES = {"rad": "rad/s", "deg": "deg/s", "m": "m/s", "mm": "mm/s", "cm": "cm/s", "rev": "rev/s"}
