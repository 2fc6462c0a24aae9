"""Units at the end of names without brackets, and ends that are indices of bodies."""

import math

import pytest

from herglotz.data import load
from herglotz.data.column_roles import heads_of
from herglotz.data.csv_columns import assign

# Cells, and name, unit and role of each.
UNITS = {
    "tip_um": ("tip", "um", "coordinate"), "pos_mm": ("pos", "mm", "coordinate"), "x_m": ("x", "m", "coordinate"),
    "cart_x_m": ("cart_x", "m", "coordinate"), "hub_m": ("hub", "m", "coordinate"),
    "theta_rad": ("theta", "rad", "coordinate"), "motor_deg": ("motor", "deg", "coordinate"),
    "angleDeg": ("angle", "deg", "coordinate"), "armPosMm": ("armPos", "mm", "coordinate"),
    "drive_voltage_V": ("drive_voltage", "V", "input"), "motor_current_mA": ("motor_current", "mA", "input"),
    "force_N": ("force", "N", "input"), "load_N": ("load", "N", "input"), "i_A": ("i", "A", "input"),
    "valve_mA": ("valve", "mA", "input"), "pump_V": ("pump", "V", "input"), "duty_%": ("duty", "%", "input"),
    "arm_N_m": ("arm", "N m", "input"), "cart_vx_m_s": ("cart_vx", "m/s", "left aside"),
    "motor_rpm": ("motor", "rpm", "left aside"), "qd1_rad_s": ("qd1", "rad/s", "left aside"),
    "acc_m_s2": ("acc", "m/s2", "left aside"), "shaft_tr_min": ("shaft", "tr/min", "left aside"),
    "omega_rad_per_s": ("omega", "rad/s", "left aside"), "housing_degC": ("housing", "degC", "left aside"),
    "pos_V": ("pos", "V", "left aside"), "flow_lpm": ("flow", "lpm", "left aside"),
    "pressure_bar": ("pressure", "bar", "left aside"), "power_W": ("power_W", "", "left aside"),
    "flux_Wb": ("flux", "Wb", "left aside"), "gap_mil": ("gap", "mil", "coordinate"),
    # Indices and words. Roles are those of the whole names.
    "left_feet": ("left_feet", "", "coordinate"), "x_lb": ("x_lb", "", "coordinate"),
    "theta_m": ("theta_m", "", "coordinate"), "x_A": ("x_A", "", "coordinate"), "q_s": ("q_s", "", "coordinate"),
    "x_g": ("x_g", "", "coordinate"), "x_min": ("x_min", "", "coordinate"), "phi_bar": ("phi_bar", "", "coordinate"),
    "tau_m": ("tau_m", "", "input"), "y_in": ("y_in", "", "coordinate"), "motor_cm": ("motor_cm", "", "input"),
    "speed_m": ("speed_m", "", "left aside"), "i_m": ("i_m", "", "coordinate"), "s_A": ("s_A", "", "coordinate"),
    "frame_mm": ("frame_mm", "", "coordinate"), "arm_bar_s": ("arm_bar_s", "", "coordinate"),
}  # fmt: skip


@pytest.mark.parametrize("cell", UNITS)
def test_the_end_of_a_name_is_its_unit_or_its_index(cell):
    # fails if volts are a coordinate, degrees are no angle, or a motor's angle or torque is a length
    found = assign(["t[s]", "z[m]", cell], "header")
    assert found.roles()[2] == (UNITS[cell][0], UNITS[cell][2], UNITS[cell][1])


@pytest.mark.parametrize(
    ("cells", "names"),
    [
        ("i_A,i_B,v_A,v_B", "i_A,i_B,v_A,v_B"),  # two bodies
        ("joint_A,joint_1", "joint_A,joint_1"),
        ("F_N,F_T", "F_N,F_T"),  # normal and tangential
        ("x_m,x_l,x_s", "x_m,x_l,x_s"),
        ("x_m,x_s[m]", "x_m,x_s"),
        ("pump_A,pump_V", "pump_A,pump_V"),  # one name for both
        ("pump_A,fan_V", "pump,fan"),
        ("x_m,y_m,p_x_m,p_y_m", "x_m,y_m,p_x_m,p_y_m"),  # momenta have the names of their coordinates
    ],
)
def test_a_letter_is_an_index_beside_another_index(cells, names):  # fails if the current of body A is in amperes
    assert [head and head[0] for head in heads_of(cells.split(","))] == names.split(",")


OVER = {
    "phi/rad": ("phi", "rad", "coordinate"), "phi / °": ("phi", "°", "coordinate"), "s/mm": ("s", "mm", "coordinate"),
    "F/N": ("F", "N", "input"), "U / V": ("U", "V", "input"), "M/(N m)": ("M", "N m", "input"),
    "v/(m/s)": ("v", "m/s", "left aside"), "v / m/s": ("v", "m/s", "left aside"), "T/°C": ("T", "°C", "left aside"),
    "n/min⁻¹": ("n", "min⁻¹", "left aside"), "n/[1/min]": ("n", "1/min", "left aside"),
    "y/in": ("y", "in", "coordinate"),
    # Paths, ratios and rates.
    "pos/vel": ("pos/vel", "", "left aside"), "a/b": ("a/b", "", "coordinate"), "x/s": ("x/s", "", "coordinate"),
    "left/min": ("left/min", "", "coordinate"), "joint/position": ("joint/position", "", "coordinate"),
    "joint/position/m": ("joint/position/m", "", "coordinate"), "dx/dt": ("dx/dt", "", "left aside"),
}  # fmt: skip


@pytest.mark.parametrize("cell", OVER)
def test_a_quantity_over_its_unit(cell):
    # fails if the notation of physics, a quantity over its unit, is a name; or a path or a ratio has a unit
    found = assign(["t/ms", "z/mm", cell], "header")
    assert found.roles()[0] == ("t", "time", "ms")
    assert found.roles()[2] == (OVER[cell][0], OVER[cell][2], OVER[cell][1])


def test_a_letter_behind_a_slash_is_a_body_beside_another(tmp_path):
    # fails if the joint of body A is an input in amperes, or a column is not found by its whole cell
    cells = ["t[s]", "joint/A", "joint/B", "load / N"]
    assert assign(cells, "header").roles()[1:] == (
        ("joint/A", "coordinate", ""), ("joint/B", "coordinate", ""), ("load", "input", "N"),
    )  # fmt: skip
    path = tmp_path / "a.csv"
    path.write_text("t / s;x / mm;F / N\n" + "".join(f"0,{k};{k % 3};{k % 4}\n" for k in range(8)))
    data = load(path, time="t / s", inputs="F / N", coordinates="x")
    assert (data.names, data.units, data.time_unit, data.input_labels) == (("x",), ("mm",), "s", (("F", "N"),))


def test_names_of_another_table_stay():
    # fails if a run of x_A and x_B, or of hub_m, does not know the same column in a table with other columns
    assert [head and head[0] for head in heads_of(["hub_A", "arm_m"], {"hub_A", "arm"})] == ["hub_A", "arm"]
    assert [head and head[0] for head in heads_of(["arm_m", "arm_l"], {"arm"})] == ["arm", "arm_l"]


def test_units_at_the_ends_of_a_log(tmp_path):
    # fails if degrees stay, or a column is not found by the name that it has in the table
    path, rows = tmp_path / "log.csv", "\n".join(f"{20 * k},{k},{30 * k},{k % 3}" for k in range(8))
    path.write_text(f"time_ms,tip_m,angleDeg,drive_V\n{rows}\n")
    data = load(path)
    assert (data.names, data.units, data.time_unit) == (("tip", "angle"), ("m", "rad"), "s")
    assert data.q[3].tolist() == pytest.approx([3, math.pi / 2])
    assert data.input_labels == (("drive", "V"),)
    assert load(path, coordinates="angleDeg", inputs="drive_V").names == ("angle",)
    circle = "\n".join(f"{k},{math.sin(k)},{-math.cos(k)}" for k in range(8))
    path.write_text(f"t,x_m,y_m\n{circle}\n")
    assert load(path, polar="x_m,y_m").names == load(path, polar="x,y").names == ("theta",)
