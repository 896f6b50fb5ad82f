"""What methods hand over to upper layers, and the types of what they return."""

# A testbed is compiled, drawn and viewed; a scenario is deployed.
from .compiled.compiled_rollouts import CompiledRollouts as CompiledRollouts
from .control.runtime import Runtime as Runtime
from .deployment.deployment import Deployment as Deployment
from .deployment.deployment import deploy as deploy

# A problem is studied.
from .optimization.study.study import Study as Study

# Calibrations, comparisons, sweeps, rollouts, decisions and studies are drawn.
from .visualization.calibrations import calibration_html as calibration_html
from .visualization.calibrations import plot_calibration as plot_calibration
from .visualization.comparisons import comparison_html as comparison_html
from .visualization.comparisons import plot_comparison as plot_comparison
from .visualization.decisions import plot_decision as plot_decision
from .visualization.diagram import svg as svg
from .visualization.meshcat import Scene as Scene
from .visualization.meshcat import show_motion as show_motion
from .visualization.plots import plot_quality as plot_quality
from .visualization.plots import plot_sweep as plot_sweep
from .visualization.study_plots import plot_history as plot_history
from .visualization.study_plots import plot_importances as plot_importances
from .visualization.study_plots import plot_landscape as plot_landscape
from .visualization.study_plots import plot_pareto as plot_pareto
from .visualization.study_plots import plot_slices as plot_slices

# A testbed and a study have a page.
from .web.live.viewer import View as View
from .web.live.viewer import view as view
from .web.study.study_page import StudyView as StudyView
from .web.study.study_page import view_study as view_study
