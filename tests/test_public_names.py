"""What is public, and that modules import only from those above them."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import drake_diff

PACKAGE = Path(drake_diff.__file__).parent
PUBLIC = """
Actuator ArtifactError Barrier Bounds Certificate CertificateError CertificationRecord ClosedLoop Comparison
ComparisonRecord Constraint Contract ContractLine DrakeDiffError Dynamics Engine EvidenceRecord Fallback Finding
Gaussian GradientCase GradientError GradientPanel Hold InputError LQR Loop MPC MissingDependencyError Model ModelError
ModelWarning NonFiniteError NotOfferedError OpenLoop PD ParametricPolicy Predictor Problem Push QuadraticCost
Recording Robustness RobustnessRecord Rollout RolloutCertificate RolloutGradient Sensor ShapeError SimulationError
Smoothed SoftContact Solution Status StepDerivatives TVLQR Transcribed UnknownNameError Verification audit
center_of_mass certify certify_jacobian certify_model certify_rollout closed_loop compare contact_force contact_modes
contact_table differentiate_rollout differentiate_step export_model frame_position frame_rotation_error frame_velocity
gradient_panel linearize list_parameters load_engine load_model load_record match_contracts model_from_diagram
plant_dynamics read_mcap read_recording read_trace robustness rollout run_panel save save_comparison
save_gradient_panel save_robustness smooth smooth_step softened solve step transcribe_and_solve verify
violation_between_nodes
""".split()
ORDER = """
exceptions arrays autodiff whole_file plant_elements model_file contact_geometry contract added_forces twin model
soft_contact read_contract tangent inertia parameter_kinds contact_parameters parameters parameter_coordinates step
finite_difference tree_dynamics engines.engine engines.euler engines.description engines.body_frame
engines.pinocchio_model implicit contact_pairs contact_material friction_cone contact_motion
analytic_step contact_jacobian analytic step_derivatives linearization smoothing policy contact quantities
mode_changes certificate rollout rollout_gradient refinement certify continuous cost bounds constraint problem replay
dynamics nonlinear_program transcription_scheme optimal_control transcribed symbolic symbolic_tree knot_functions
transcription_program ipopt transcription solution mathematical_program collocation shooting shooting_program riccati
secant augmented_lagrangian expansion ilqr contact_sequence goal_restoration continuation verdict run solver
mcap_messages mcap_read mcap_log mcap_recover trace_read trace_motion trace_solve trace page html_parts meshcat_scene
meshcat_view report_data report record_parts record record_schema record_file certification_record named_files
provenance problem_record plan_file record_sections metrics invariants failures events evidence rerun verification
verify runs view sampling certification audit_place audit_contact audit engines.closed_form
engines.closed_form_contact engines.numpy_engine engines.drake_engine engines.pinocchio_engine engines.urdf
engines.casadi_engine engines.mjcf engines.mujoco_coordinates engines.mujoco_contract engines.mujoco_model
engines.mujoco_engine engines.mjx_engine engines.quiet engines.rigid_links engines.centers engines.newton_contract
engines.newton_engine engines.bullet_urdf engines.bullet_contract engines.pybullet_engine engines.sapien_contract
engines.sapien_engine engines.contract_match engines.load engines.attribution engines.motion engines.jacobians
engines.recording engines.recording_ros2 engines.recording_files engines.recorded engines.comparison_task
engines.compared engines.comparison engines.comparison_record engines.comparison_words engines.comparison_page
engines.comparison_trace engines.comparison_files engines.contact_cases engines.contact_laws engines.contact_table
engines.contact_words engines.sdf engines.usd engines.read_back engines.small_models engines.export_readme
engines.export loop.statistics loop.checks loop.sensor loop.estimator loop.actuator loop.fallback loop.closed_loop
loop.controllers loop.mpc panels.panel_file panels.trial_row panels.journal panels.local_workers panels.ray_workers
panels.workers panels.table panels.panel loop.perturbation loop.trial loop.sensitivity loop.robustness
loop.robustness_record loop.robustness_words loop.trial_trace loop.trial_files loop.robustness_plots
loop.robustness_page loop.robustness_files loop.panel_trial gradient_estimate gradient_descent gradient_panel_cases
gradient_panel gradient_panel_files ros2_bag cli_options cli_mcap cli_runs cli_engines cli_panel cli_gradients
cli_export cli_view cli_contact cli_robustness cli
""".split()


def test_the_public_names_are_these():
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {"engines", "loop", "panels"}
    functions = {name for name in vars(drake_diff) if not name.startswith("_")}
    assert sorted(functions - (modules - set(PUBLIC))) == sorted(PUBLIC)
    for name in PUBLIC:
        assert callable(getattr(drake_diff, name)), name  # no module hides a function of its name


def test_every_public_name_is_documented():
    for name in PUBLIC:
        assert getattr(drake_diff, name).__doc__, name


def _dotted(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def test_every_module_has_its_place_and_imports_only_from_above():
    modules = {_dotted(path) for path in PACKAGE.rglob("*.py") if path.stem != "__init__"}
    assert modules == set(ORDER)
    for name in ORDER:
        tree = ast.parse((PACKAGE / f"{name.replace('.', '/')}.py").read_text())
        for node in tree.body:  # what functions import when called is not in the way of data
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("drake_diff."):
                imported = node.module.removeprefix("drake_diff.")
                assert ORDER.index(imported) < ORDER.index(name), f"{name} imports {imported}"


def test_the_readme_lists_the_modules_in_their_order():
    text = (PACKAGE.parent / "README.md").read_text()
    listed = [line for line in text[text.index("## How to change it") :].splitlines() if line.startswith("| ")]
    assert [name for line in listed for name in re.findall(r"`([\w.]+)`", line)] == ORDER


def test_no_module_is_too_long_and_none_asserts():
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text()
        assert len(text.splitlines()) <= 320, path.name
        assert not any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(text))), path.name


def test_importing_the_package_loads_neither_plots_nor_viewers_nor_logs():
    late = ("matplotlib", "mcap", "typer", "mujoco", "pinocchio", "casadi")
    code = f"import sys, drake_diff; print([m for m in {late} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
