from .contact_comparison import contact_table as contact_table
from .gradient_estimates import GradientCase as GradientCase
from .gradient_study import GradientPanel as GradientPanel
from .gradient_study import gradient_panel as gradient_panel
from .gradient_study import save_gradient_panel as save_gradient_panel
from .without_derivatives import without_derivatives as without_derivatives
