#!/usr/bin/env python3
"""Draw the method for the README: data/figures/method.png."""
import sys
from pathlib import Path

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
import plots  # noqa: E402

EXPERT, STUDENT, PLAIN = "#f3d9c9", "#cfe3f1", "#eeeeee"


def main():
    """Expert and student from left to right, and where Equation 4 compares them."""
    plt = plots.pyplot()
    figure, ax = plt.subplots(figsize=(11, 4.1), layout="constrained")
    ax.set(xlim=(0, 110), ylim=(0, 41))
    ax.axis("off")

    def box(x, y, width, text, color, height=5):
        ax.add_patch(plt.Rectangle((x, y), width, height, facecolor=color, edgecolor="#333333"))
        ax.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=9)

    def arrow(x, y, to_x, to_y):
        ax.annotate("", (to_x, to_y), (x, y), arrowprops={"arrowstyle": "->", "color": "#333333"})

    box(1, 24, 13, "observation g", PLAIN)
    box(19, 24, 14, "expert's encoder\n(frozen)", EXPERT)
    box(39, 33, 38, "expert: one dynamics $f_T$, reward $f_R$, value $f_Q$\n"
        "for the whole latent and all joints' actions", EXPERT, 6)
    box(39, 24, 13, "student's\nencoder", STUDENT)
    arrow(14, 26.5, 19, 26.5)
    arrow(33, 26.5, 39, 26.5)
    arrow(33, 28, 39, 35)
    for row, (y, name) in enumerate(((16, "1"), (10, "2"), (2, "N"))):
        box(39, y, 13, f"latent $s^{name}$", STUDENT, 4)
        box(55, y, 22, f"$f_T^{name}, f_R^{name}, f_Q^{name}$   joint {name}'s $a^{name}$",
            STUDENT, 4)
        arrow(52, y + 2, 55, y + 2)
        arrow(77, y + 2, 83, 12)
        if not row:
            arrow(45.5, 24, 45.5, 20)
    ax.text(45.5, 8, "...", ha="center", va="center")
    ax.text(66, 8, "...", ha="center", va="center")
    box(83, 9, 10, "sum, or here\njoint by joint\n[D9]", PLAIN, 6)
    box(94, 20, 15, "the same order\nof K actions?\n(Equation 4)", PLAIN, 8)
    arrow(77, 36, 101.5, 28)
    arrow(93, 12, 101.5, 20)
    ax.text(1, 12, "To plan, each joint searches its own\naction sequences with its own small\n"
            "model (Equations 2 and 3): since\nrewards and values are sums, the best\n"
            "plan is the best of each. Its prior,\ntaught what the expert's policy does,\n"
            "acts without a search, or begins one.", va="center", fontsize=9)
    ax.set_title("An expert's world model is distilled into one small model for each joint",
                 fontsize=11)
    plots.save_figure(fac.DATA / "figures" / "method.png", figure)


if __name__ == "__main__":
    main()
