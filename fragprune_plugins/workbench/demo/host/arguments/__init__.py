"""Command-line options in three groups; every public attribute of a group becomes a flag."""

import ast
from argparse import ArgumentParser, Namespace
from pathlib import Path


class ParamGroup:
    """Turns the attributes set before ``super().__init__`` into flags.

    An attribute with a leading underscore also gets its first letter as a short flag.
    """

    def __init__(self, parser: ArgumentParser, title: str, fill_none: bool = False):
        group = parser.add_argument_group(title)
        for key, value in vars(self).items():
            name = key.removeprefix("_")
            flags = [f"--{name}"] + ([f"-{name[0]}"] if key.startswith("_") else [])
            default = None if fill_none else value
            if isinstance(value, bool):
                group.add_argument(*flags, default=default, action="store_true")
            else:
                group.add_argument(*flags, default=default, type=type(value))

    def extract(self, args: Namespace) -> Namespace:
        """A namespace of this group's options."""
        names = {key.removeprefix("_") for key in vars(self)}
        return Namespace(**{key: value for key, value in vars(args).items() if key in names})


class ModelParams(ParamGroup):
    """Options of the data and the model's folder."""

    def __init__(self, parser: ArgumentParser, sentinel: bool = False):
        self.sh_degree = 3
        self._source_path = ""
        self._model_path = ""
        self._images = "images"
        self._resolution = -1
        self._white_background = False
        self.data_device = "cuda"
        self.eval = False
        super().__init__(parser, "Loading", sentinel)

    def extract(self, args: Namespace) -> Namespace:
        """A namespace of this group's options, with an absolute source folder."""
        group = super().extract(args)
        group.source_path = str(Path(group.source_path).resolve())
        return group


class PipelineParams(ParamGroup):
    """Options of render(): the parts to compute in Python."""

    def __init__(self, parser: ArgumentParser):
        self.convert_SHs_python = False
        self.compute_cov3D_python = False
        self.debug = False
        super().__init__(parser, "Pipeline")


class OptimizationParams(ParamGroup):
    """Learning rates and the timetable of densification, in iterations."""

    def __init__(self, parser: ArgumentParser):
        self.iterations = 30_000
        self.position_lr_init = 0.00016
        self.position_lr_final = 0.0000016
        self.position_lr_max_steps = 30_000
        self.feature_lr = 0.0025
        self.opacity_lr = 0.05
        self.scaling_lr = 0.005
        self.rotation_lr = 0.001
        self.percent_dense = 0.01
        self.lambda_dssim = 0.2
        self.densification_interval = 100
        self.opacity_reset_interval = 3000
        self.densify_from_iter = 500
        self.densify_until_iter = 15_000
        self.densify_grad_threshold = 0.0002
        self.random_background = False
        super().__init__(parser, "Optimization")


def get_combined_args(parser: ArgumentParser) -> Namespace:
    """The options of a model's training (its cfg_args), overridden by those of the command."""
    given = parser.parse_args()
    call = ast.parse((Path(given.model_path) / "cfg_args").read_text(), mode="eval").body
    merged = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    merged.update({key: value for key, value in vars(given).items() if value is not None})
    return Namespace(**merged)
