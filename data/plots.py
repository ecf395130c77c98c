"""This project's figures: one style, written whole, and no run lost where one can't be drawn."""
import contextlib
import io
import os
import sys
from pathlib import Path

import fac_tdmpc_ref as fac


def pyplot():
    """matplotlib.pyplot, in this project's style, without a display; UserError if missing."""
    os.environ.pop("MPLBACKEND", None)  # a notebook's, which may not be here
    with fac.optional("matplotlib", "plots"):
        import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    cycle = matplotlib.cycler(  # told apart in black and white, too
        color=["#0072b2", "#d55e00", "#009e73", "#333333", "#cc79a7", "#e69f00", "#56b4e9"],
        linestyle=["-", "--", "-.", ":", "-", "--", "-."])
    plt.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "axes.prop_cycle": cycle,
                         "text.usetex": False})
    return plt


def pyplot_for(path):
    """matplotlib.pyplot; UserError, before the work, if no picture can be written there."""
    fac.need(Path(path).suffix == ".png" and not Path(path).is_dir(),
             f"{path}: expected the name of a .png file")
    fac.check_writable(path)
    return pyplot()


@contextlib.contextmanager
def panels(path, count, most, width, height, **options):
    """So many axes, at most `most` in a row, of this size; in the end one legend for all, and the
    picture is written."""
    columns = min(most, count)
    rows = -(-count // columns)
    figure, grid = pyplot().subplots(rows, columns, squeeze=False, layout="constrained",
                                     figsize=(width * columns, height * rows), **options)
    axes = grid.flat[:count]
    for ax in grid.flat[count:]:
        ax.remove()
    yield axes
    handles = {label: handle for ax in axes
               for handle, label in zip(*ax.get_legend_handles_labels())}
    figure.legend(handles.values(), handles, loc="outside lower center", fontsize=8,
                  ncols=2 * columns)
    drawn(save_figure, path, figure)


def save_figure(path, figure):
    """Write a figure as PNG, in 64 colours (a third as large), and forget it."""
    from PIL import Image  # which matplotlib needs
    figure.savefig(picture := io.BytesIO(), dpi=110, format="png")
    with fac.atomic_file(path) as file:
        Image.open(picture).convert("RGB").quantize(64).save(file, "png", optimize=True)
    pyplot().close(figure)


def drawn(draw, path, *what):
    """Whether draw(path, ...) made its picture; what goes wrong is said, and costs nothing else."""
    try:
        draw(path, *what)
        return True
    except Exception as error:
        print(f"{path}: no picture: {' '.join(str(error).split())[:300]}", file=sys.stderr)
        return False
