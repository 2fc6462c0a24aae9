"""Roles of columns by their units and words: what a logger calls its columns, and what is said of guesses."""

import pytest

from herglotz.data import load
from herglotz.data.column_roles import is_set_point
from herglotz.data.csv_columns import assign
from herglotz.errors import InputError

ROLES = {
    # An explicit unit says more than a word.
    "motor_pos[deg]": "coordinate", "current_height[mm]": "coordinate", "motor[rad]": "coordinate",
    "torque_arm_angle[deg]": "coordinate", "control_surface[deg]": "coordinate", "Actual Position [mm]": "coordinate",
    "input_gear[rad]": "coordinate", "s[m]": "coordinate", "p_x[mm]": "coordinate", "F[mm]": "coordinate",
    "motor_rate[rad/s]": "left aside", "current_speed[km/h]": "left aside", "shaft[rpm]": "left aside",
    "tau[rad/s]": "left aside", "command[m]": "input", "ServoCurrent [mA]": "input", "drive[%]": "input",
    "push[lbf]": "input", "armature[A]": "input", "housing[°C]": "left aside", "oil[bar]": "left aside",
    "supply_voltage[V]": "left aside", "MotorTemp[C]": "left aside", "loop[ms]": "left aside", "power[W]": "left aside",
    # Units of other fields, and of other countries.
    "flux[Wb]": "left aside", "linkage[mWb]": "left aside", "field[mT]": "left aside", "coil[mH]": "left aside",
    "plate[pF]": "left aside", "oil[kPa]": "left aside", "gap[mil]": "coordinate", "tilt[arcsec]": "coordinate",
    "tilt[arcmin]": "coordinate", "spool[revs]": "coordinate", "stage[inches]": "coordinate", "grip[lb]": "input",
    "wrench[ft-lb]": "input", "crank[N-m]": "input", "servo[oz-in]": "input", "pull[kN]": "input", "bearing[K]":
    "left aside", "line[Hz]": "left aside", "spindle[turns]": "coordinate", "mill[rev/min]": "left aside",
    # What is wanted of a motion is an input.
    "q_cmd": "input", "thetaRef": "input", "Set Point [mm]": "input", "x_desired[m]": "input", "demand": "input",
    "set_position": "input", "wanted angle": "input", "Sollwinkel": "input", "x_set[m]": "input", "set": "coordinate",
    "angle_sp[deg]": "input", "Sollwert[mm]": "input", "target_vel[m/s]": "input", "commanded_angle": "input",
    # Words without a unit.
    "motor_position": "coordinate", "ActPos": "coordinate", "left_motor": "input", "friction_torque": "input",
    "motor_encoder": "coordinate", "yaw": "coordinate", "Kraft": "input", "courant": "input", "fuerza": "input",
    "coppia": "input", "Strom": "input", "Fx": "input", "throttle": "input", "iq": "input", "quality": "left aside",
    "position_std": "left aside",
    # Rates and counters.
    "qd1": "left aside", "qdd": "left aside", "dq2": "left aside", "yvel": "left aside", "phi_vel": "left aside",
    "ddx": "left aside", "dphi/dt": "left aside", "wz": "left aside", "v2": "left aside", "a_x": "left aside",
    "joint_speed": "left aside", "yawrate": "left aside", "Geschwindigkeit": "left aside", "vitesse": "left aside",
    "velocidad": "left aside", "Temperatur": "left aside", "alphadot": "left aside", "dt": "left aside",
    # Compounds by their last part, words without their accents, and what loggers of robots write.
    "Motorstrom": "input", "Pendelwinkel": "coordinate", "Schleppfehler[mm]": "left aside", "angulo": "coordinate",
    "Winkelbeschleunigung": "left aside", "aceleracion": "left aside", "Stellgröße": "input", "Führungsgröße": "input",
    "commande": "input", "voltaje": "input", "referencia": "input", "erreur": "left aside", "Leistung": "left aside",
    "GRF_z": "input", "ctrl": "input", "action": "input", "reward": "left aside", "imu_ax": "left aside",
    "Sub Frame": "left aside", "Frame#": "left aside", "Winkelabweichung[deg]": "coordinate",
    # What moves a mechanism from outside, also in compounds.
    "Fußpunkterregung[mm]": "input", "Bodenanregung[m]": "input", "Erregerwinkel[rad]": "input", "erregung": "input",
    "Anregungssignal": "input", "Fußpunkt[mm]": "input", "excitación[mm]": "input", "Erregerkraft": "input",
    # A copy of another column, theta; filters of columns that are not there are names.
    "theta_filt[rad]": "left aside", "theta_smoothed": "left aside", "filtered theta[deg]": "left aside",
    "phi_filt[rad]": "coordinate", "filter[mm]": "coordinate", "help": "coordinate",
    # The usual letters, words and counters.
    "force[N]": "input", "F[N]": "input", "F": "input", "torque[Nm]": "input", "Torque": "input", "tau_1": "input",
    "tau2": "input", "u1": "input", "u_0": "input", "M[N*m]": "input", "voltage[V]": "input", "current": "input",
    "cmd": "input", "command_1": "input", "control": "input", "input": "input", "effort_1": "input", "pwm2": "input",
    "v": "left aside", "vx": "left aside", "velocity_x": "left aside", "x_dot": "left aside", "x_ddot": "left aside",
    "acc": "left aside", "gyro[rad/s]": "left aside", "a[m/s^2]": "left aside", "b (mm/s²)": "left aside",
    "index": "left aside", "frame": "left aside", "Unnamed: 0": "left aside", "theta2ddot": "left aside",
    "omega_1": "left aside", "gFx": "left aside", "aceleracion_base": "input", "Boden[mm]": "input",
    "déplacement sol[mm]": "input", "quake_acc_g": "input", "thrust_pct": "input", "Gewenste hoek[°]": "input",
    # The width of a pulse commands a servo, a latency does not; us is a unit of time or ultrasound.
    "pwm [us]": "input", "servo_duty[ms]": "input", "pulse width[us]": "input", "latency[ms]": "left aside",
    "pwm_time[us]": "left aside", "us_distance": "coordinate", "us[mm]": "coordinate", "us_left[cm]": "coordinate",
    # An input by its last word, and parts of machines; gravities of accelerometers, and a name.
    "tendon_input[mm]": "input", "valve control 2[deg]": "input", "input_shaft[rad]": "coordinate",
    "ax_g": "left aside", "acc_x_g": "left aside", "accel_g": "left aside", "q_g": "coordinate", "drum_g": "coordinate",
    # Names that only begin like a force.
    "f": "coordinate", "N": "coordinate", "taut": "coordinate", "motion": "coordinate", "uplift": "coordinate",
    "forceful": "coordinate", "up": "coordinate", "unit[Nms]": "coordinate", "cmds": "coordinate",
    # No rates: there is no column ist or x, or the unit is that of a position.
    "dist": "coordinate", "dz[mm]": "coordinate", "v1[m]": "coordinate", "depth": "coordinate", "vy (mm)": "coordinate",
    "az[deg]": "coordinate",
    "base_angle[rad]": "coordinate", "elbow_x": "coordinate",
}  # fmt: skip


def read(folder, text, **options):
    path = folder / "motion.csv"
    path.write_text(text)
    return load(path, **options)


def table(header, rows=8):
    """Text of a csv file: numbers that grow differently in every column."""
    count = header.count(",") + 1
    lines = (",".join(f"{(k / 8) ** (1 + j / 3):.5g}" for j in range(count)) for k in range(rows))
    return "\n".join([header, *lines]) + "\n"


@pytest.mark.parametrize("cell", ROLES)
def test_units_and_words_give_roles(cell):
    # fails if a first word decides against the unit, a set point is a second coordinate, or a rate is one
    assert assign(["t[s]", "theta[rad]", cell], "header").roles()[2][1] == ROLES[cell]


def test_a_unit_without_a_space_before_it():
    # fails if x(m) is a coordinate without a unit, v(m/s) a coordinate, or the brackets of a name hold a unit
    found = assign(["t(s)", "x(m)", "v(m/s)", "F(N)", "x(1)"], "header")
    assert found.names == ("t", "x", "v", "F", "x(1)")
    assert found.units == ("s", "m", "m/s", "N", "")
    assert [role for _, role, _ in found.roles()] == ["time", "coordinate", "left aside", "input", "coordinate"]


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("t[s],sway[deg],trolley acceleration[m/s^2]", True),
        ("t[s],x[m],arm acceleration[rad/s²]", True),
        ("t[s],x[mm],x acceleration[m/s^2]", False),
        ("t[s],sway[deg],x[m],trolley acceleration[m/s^2]", False),
        ("t[s],sway,trolley acceleration[m/s^2]", False),
    ],
)
def test_an_acceleration_of_something_else_may_be_an_input(tmp_path, capsys, header, said):
    # fails if the acceleration of a crane's trolley, which drives the sway of its load, is left aside without a word
    name = header.split(",")[-1].split("[")[0]
    data = read(tmp_path, table(header))
    text = (
        f"{name} is left aside, but no coordinate has its kind of unit, and it may be an input; if so, give --inputs '"
    )
    assert (text in capsys.readouterr().err) is said
    read(tmp_path, table(header), like=data)
    read(tmp_path, table(header), drop=name)
    assert "kind of unit" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("t[s],setpoint[mm],gap[mm],coil current[A]", True),
        ("t[s],q_ref[rad],q[rad],tau[Nm],i[A]", True),
        ("t[s],goal_angle[rad],angle[rad]", False),  # a servo of which no more was recorded
        ("t[s],torque_command[Nm],angle[rad],wind[N]", False),  # what acts is in the unit of what acts
    ],
)
def test_a_goal_beside_what_acts_is_said(tmp_path, capsys, header, said):
    # fails if a model of a controller's law, a magnet that hangs by 38.5 times its set point, is found unsaid; if there
    # is a warning where nothing else acts, or after the user has spoken
    data = read(tmp_path, table(header))
    warnings = [line for line in capsys.readouterr().err.splitlines() if "controller's law" in line]
    assert bool(warnings) is said
    goal = header.split(",")[1].split("[")[0]
    assert all(f"--drop {goal} leaves the machine's" in line for line in warnings)
    read(tmp_path, table(header), like=data)
    read(tmp_path, table(header), inputs=[name for name, _ in data.input_labels])
    assert "controller's law" not in capsys.readouterr().err


GUESSES = {
    "road[mm]": "is taken for an input, but by its name alone; else give --coordinates x,road or --drop road",
    "exciter[mm]": "is taken for an input, but by its name alone",
    "pivot_acceleration[m/s^2]": "is taken for an input, but by its name alone; else give --drop pivot_acceleration",
    "tendon_input[mm]": "is taken for an input, but it has the unit of a position; else give --coordinates x,",
    "support[m]": "is taken for an input, but by its name alone",
    "pivot_y[m]": "is taken for a coordinate, but it may be moved from outside; else give --inputs pivot_y or",
    "u_x[m]": "is taken for an input, but it has the unit of a position",
    "control[rad]": "is taken for an input, but it has the unit of a position",
    "q_d": "is left aside, but it may be a desired value or a derivative; if so, give --inputs q_d or",
    "q_d[rad]": "is taken for an input, but it may be a desired value or a derivative",
    "x_dot[m]": "is left aside, but it has the unit of a position",
    "dx[m]": "is left aside, but it has the unit of a position",
    "valve[bar]": "is left aside, but it may be an input",
    "x_lp": "is left aside, but it may be more than a filtered copy of another column; if so, give --inputs x_lp or",
    "pot[V]": "is left aside, but it may be the reading of a position",
    "flux[Wb]": "is left aside, but it may be the reading of a position; if so, give --inputs flux or",
    "motor_x": "is taken for a coordinate, but its name may be that of an input",
    "input_shaft[rad]": "is taken for a coordinate, but its name may be that of an input; else give --inputs",
    "input_angle": "is taken for a coordinate, but its name may be that of an input",
    "load": "is taken for a coordinate, but no unit and no usual name says so; else give --inputs load or --drop load",
}


@pytest.mark.parametrize("cell", GUESSES)
def test_what_is_a_guess_is_said_in_a_warning(tmp_path, capsys, cell):
    # fails if a role that may be wrong stands in the table of columns alone, or the remedy is another file's
    name = cell.split("[")[0]
    data = read(tmp_path, table(f"t[s],x[m],{cell}"))
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"warning: motion.csv: {name} {GUESSES[cell]}")
    read(tmp_path, table(f"t[s],x[m],{cell}"), like=data)
    told = {"inputs": name} if "--inputs" in GUESSES[cell] else {"coordinates": ["x", name]}
    read(tmp_path, table(f"t[s],x[m],{cell}"), **told)
    assert "warning" not in capsys.readouterr().err  # it is known by then, or the user has said it


def test_no_acceleration_is_offered_as_a_coordinate():
    # fails if the remedy for a road in mm makes a position of an accelerometer beside it
    for unit in ("[m/s2]", "[g]", ""):
        (said,) = assign(["t[s]", "damper[mm]", "road[mm]", f"ground_acc{unit}"], "header").notes
        assert said == (
            "warning: road, ground_acc are taken for inputs, but by their names alone; else give --coordinates "
            "damper,road or --drop road,ground_acc"
        )
    (said,) = assign(["t[s]", "pitch[deg]", "ax_g"], "header").notes
    assert said.endswith("it may be an input; if so, give --inputs ax")
    (said,) = assign(["t[s]", "pitch[deg]", "ax_g", "ay_g"], "header").notes
    assert said.endswith(
        "ax, ay are left aside, but no coordinate has their kind of unit, and they may be inputs; if so, give --inputs "
        "ax,ay"
    )


def roles(header):
    """The roles of the columns of a header but the time."""
    return [role for _, role, _ in assign(header.split(","), "header").roles()][1:]


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("t[s],floor[mm],damper[mm],base_acc[m/s2]", "coordinate coordinate input"),
        ("t[s],floor[mm],damper[mm],ground[g]", "coordinate coordinate input"),
        ("t[s],floor[mm],body[mm],road[mm]", "coordinate coordinate input"),
        ("t,floor1,floor2,u", "coordinate coordinate input"),
        ("t[s],2nd floor[mm],roof[mm],shaker force[N]", "input coordinate input"),
        ("t[s],floor 1[mm],floor 1 acc[m/s2],base_acc[m/s2]", "coordinate left aside input"),
        ("t[s],floor[mm],table[mm]", "input coordinate"),
        ("t[s],floor[mm],floor_acc[m/s2],table[mm]", "input input coordinate"),
    ],
)
def test_a_floor_is_a_storey_where_something_else_shakes(header, expected):
    # fails if the storey of a building whose base is shaken is an input, or the floor below a table a coordinate
    assert " ".join(roles(header)) == expected


def test_a_storey_is_a_guess():  # fails if a floor beside a base is a coordinate without a word
    said, _ = assign(["t[s]", "floor[mm]", "damper[mm]", "base_acc[m/s2]"], "header").notes
    assert said.endswith(
        "coordinate, but it may be moved from outside; else give --inputs base_acc,floor or --drop floor"
    )


def test_a_share_of_a_nominal_value_is_no_position():
    # fails if powers and voltages in per unit are coordinates beside the angle of a generator, or a travel is none
    header = "t_s,delta_deg,omega_pu,Pm_pu,Pe [p.u.],Vt (pu)"
    assert " ".join(roles(header)) == "coordinate left aside input input input"
    (said,) = assign(header.split(","), "header").notes
    assert said == "warning: Pm, Pe, Vt are taken for inputs, but by their units alone; else give --drop Pm,Pe,Vt"
    assert " ".join(roles("t,x_pu,u[pu],s[pu],torque[pu],Q[pu]")) == "coordinate input input input input"


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("t[s],input_x[mm],x[mm]", "input coordinate"),
        ("t[s],Eingang[mm],Ausgang[mm]", "input coordinate"),
        ("t[s],entrée[mm],x[mm]", "input coordinate"),
        ("t[s],x_in[mm],x_out[mm]", "input coordinate"),
        ("t,in,out", "input coordinate"),
        ("t,x_in,y_in", "coordinate coordinate"),
        ("t[s],input_angle[deg],output_angle[deg]", "coordinate coordinate"),
        ("t[s],Zielwinkel[deg],cible[deg],x[deg]", "input input coordinate"),
    ],
)
def test_a_word_for_an_input_anywhere_in_a_name(header, expected):
    # fails if `input` in front of the name of another column makes a second coordinate, or inches are an input
    assert " ".join(roles(header)) == expected


def test_a_quantity_in_its_unit():  # fails if "Weg in mm" is a name without a unit
    found = assign(["Zeit in ms", "Weg in mm", "angle en °", "v in m/s", "x in box"], "header")
    assert found.names == ("Zeit", "Weg", "angle", "v", "x in box")
    assert found.units == ("ms", "mm", "°", "m/s", "")


def test_raw_values_are_fitted_and_their_filtered_copy_is_not():
    # fails if both are coordinates, or a force that was filtered by a logger's channel of its own leaves the inputs
    found = assign(["t[s]", "x_filtered[mm]", "x_raw[mm]", "F[N]", "F_filt[N]"], "header")
    assert (found.q, found.u) == ((2,), (3, 4))


@pytest.mark.parametrize(
    "header",
    ["t,a", "t,a,u", "t,x,Erregerkraft", "t[s],theta[rad],x[m],F[N]", "t,q1,q2,u", "Zeit,Winkel[°],Moment[Nm],T[°C]"],
)
def test_nothing_is_said_of_what_is_clear(tmp_path, capsys, header):  # fails if every table is warned of
    read(tmp_path, table(header))
    assert "warning" not in capsys.readouterr().err


def test_two_columns_that_nothing_tells_apart_are_a_guess(tmp_path, capsys):
    # fails if a table t,a,b is fitted as two coordinates without a word: one of them may drive the other
    read(tmp_path, table("t,a,b"))
    said = "warning: motion.csv: a, b are taken for coordinates, but no unit and no usual name says so; else give"
    assert said + " --inputs or --drop with the names of those that are none" in capsys.readouterr().err
    read(tmp_path, table("t,a,b"), coordinates=["a", "b"])
    assert "warning" not in capsys.readouterr().err


def test_many_columns_without_a_usual_name_are_one_warning(tmp_path, capsys):  # fails if a wide table fills a terminal
    read(tmp_path, table("t,x[m]," + ",".join(f"node{k}" for k in range(30))))
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]
    assert len(lines) == 1
    assert "node0, node1, node2, node3, node4, 25 more are taken for coordinates" in lines[0]


@pytest.mark.parametrize(
    "name", ["Zeit", "Zeit[s]", "temps", "tiempo", "elapsed_time", "simTime[s]", "seconds", "clock[s]", "Messzeit"]
)
def test_times_in_other_words(tmp_path, name):  # fails if a time is a coordinate, and the user is told there is none
    data = read(tmp_path, table(f"x[m],{name},u_t[N]"))
    assert data.columns[1][1] == "time"
    assert data.t.tolist() == pytest.approx([(k / 8) ** (4 / 3) for k in range(8)], rel=1e-4, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "unit", "count"),
    [("millis", "ms", 1e3), ("micros", "us", 1e6), ("ms", "ms", 1e3), ("elapsed_millis", "ms", 1e3), ("t", "", 1)],
)
def test_a_time_whose_name_says_its_unit(tmp_path, capsys, name, unit, count):
    # fails if Arduino's millis() is no time, or is taken for seconds, by itself and where the user names it
    text = f"{name},x[mm]\n" + "".join(f"{20 * k},{k**1.5:.4g}\n" for k in range(8))
    for options in ({}, {"time": name}):
        data = read(tmp_path, text, **options)
        assert data.time_unit == "s"
        assert data.t[-1].item() == pytest.approx(140 / count)
    said = f"{unit}, converted to s" if unit else "- (taken for s)"
    assert capsys.readouterr().err.count(said) == 2


def test_of_several_times_those_are_meant_that_increase(tmp_path):
    # fails if a column in a unit of time is asked for though its values go up and down, or a constant one is a time
    rows = "".join(f"{k % 25},{1200 + 300 * (k % 2)},50,{k % 7}\n" for k in range(50))
    data = read(tmp_path, "tick[ms],opening[us],period[ms],x[mm]\n" + rows)
    assert [role for _, role, _ in data.columns] == ["time", "left aside", "left aside", "coordinate"]
    assert data.lengths == (25, 25)
    rows = "".join(f"{k},{1200 + 300 * (k % 2)},{k % 7},1\n" for k in range(50))
    assert read(tmp_path, "tick[ms],opening[us],x[mm],note\n" + rows).names == ("x",)


def test_two_times_are_asked_for(tmp_path):  # fails if one of two is chosen unsaid
    with pytest.raises(InputError, match="two time columns, sim_time and wall_time; choose one with --time NAME"):
        read(tmp_path, table("sim_time,wall_time,x[m]"))
    assert read(tmp_path, table("t,loop_time,x[m]")).names == ("x",)


@pytest.mark.parametrize("head", ["y[V]", "pot[mV]", "x1[%]", "theta[V]", "flux[Wb]", "flux(mWb)", "hall[T]"])
def test_volts_of_a_sensor_are_a_coordinate_where_nothing_else_is(head):
    # fails if a circuit that is a mechanism's analogue is refused, or volts are a second coordinate beside metres
    alone = assign(["t[s]", head, "u[V]"], "header")
    assert (alone.q, alone.u) == ((1,), (2,))
    assert "taken for a coordinate, but its unit is none of a position" in alone.notes[0]
    beside = assign(["t[s]", head, "z[m]", "u[V]"], "header")
    assert (beside.q, beside.u) == ((2,), (3,))
    assert "left aside, but it may be the reading of a position" in beside.notes[0]
    assert assign(["t[s]", "x[N]", "z[m]"], "header").u == (1,)


def test_a_readme_beside_recordings(tmp_path, capsys):
    # fails if a folder is refused for its README, notes or a list of properties, if what is left out for that is not
    # said, if a recording in .txt is left out, or a warning of one file has no name
    for name, header in (("a.csv", "t[s],x[m]"), ("b.txt", "t[s],x[m]"), ("c.csv", "t[s],x[m]")):
        (tmp_path / name).write_text(table(header))
    (tmp_path / "README.txt").write_text("x[m]   the cart\nt[s]   time\n")
    assert len(load(tmp_path)) == 3
    (tmp_path / "c.csv").write_text(table("t[s],x[m],road[m]"))
    for name in ("a.csv", "b.txt"):
        (tmp_path / name).write_text(table("t[s],x[m],u_road[m]"))
    capsys.readouterr()
    load(tmp_path)
    err = capsys.readouterr().err
    assert f"warning: {tmp_path.name}: c.csv: road is taken for an input" in err
    (tmp_path / "notes.txt").write_text("of 3. 5. 2024, the spring of 52 N/m\n")
    (tmp_path / "info.csv").write_text("mass,0.3\nspring;52,1\n")
    assert len(load(tmp_path)) == 3
    out = "left out of the folder, for no line has two numbers: README.txt, info.csv, notes.txt"
    assert out in " ".join(capsys.readouterr().err.split())
    (tmp_path / "d.csv").write_text("t[s],x[m]\n0,1\n1,two\n2,3\n3,4\n")
    with pytest.raises(InputError, match=r"d.csv, row 3, .*; or take d.csv out of the folder"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("V_cmd", False), ("I_ref", False), ("u_cmd", False), ("v_cmd", True), ("q_cmd", True), ("x_soll", True)],
)
def test_a_commanded_voltage_is_no_set_point(name, wanted):
    # fails if the verdict on a motor that follows its voltage names --drop V_cmd
    assert is_set_point(name, "") is wanted
