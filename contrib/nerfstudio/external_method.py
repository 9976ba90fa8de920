"""The entry of this package in Nerfstudio's `external_methods.py`."""

from nerfstudio.configs.external_methods import ExternalMethod, external_methods

# E-NeRF
external_methods.append(
    ExternalMethod(
        """[bold yellow]E-NeRF[/bold yellow]
For more information visit: https://docs.nerf.studio/nerfology/methods/enerf.html

To enable E-NeRF, you must install it first by running:
  [grey]pip install enerf-ns[/grey]""",
        configurations=[
            ("enerf", "E-NeRF from events, or events and frames. Fast on a CPU, corrects clock and poses"),
            ("enerf-paper", "E-NeRF with the sampling and field of the paper"),
            ("enerf-paper-loss", "enerf with the loss of E-NeRF"),
            ("enerf-eventnerf", "enerf with the loss of EventNeRF"),
            ("enerf-robust", "enerf with the loss of Robust e-NeRF"),
            ("enerf-deblur", "enerf with the loss of Deblur e-NeRF"),
        ],
        pip_package="enerf-ns",
    )
)
