from . import quantities as quantities
