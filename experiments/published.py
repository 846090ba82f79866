"""Figures of the paper (L2DGS, CVPR 2026), which the tables show beside our own."""

REGIONS = ("dynamic", "static", "overall")
MEASURES = ("psnr", "ssim", "lpips_alex")  # the paper does not say which network it uses for LPIPS

Figures = dict[str, dict[str, float]]  # scores by region and measure


def _cells(text: str) -> Figures:
    """Scores of one row, from its figures in the order of the paper's columns."""
    figures = iter(map(float, text.split()))
    return {region: {measure: next(figures) for measure in MEASURES} for region in REGIONS}


# Table 1, by the expected name of each scene's folder.
TABLE1 = {
    "mochi": {
        "AlethNeRF": _cells("14.32 0.50 0.17 15.53 0.66 0.23 14.95 0.59 0.40"),
        "LLNeRF": _cells("13.60 0.60 0.08 13.37 0.67 0.10 13.45 0.64 0.18"),
        "LITA-GS": _cells("10.37 0.41 0.13 10.71 0.64 0.17 10.51 0.54 0.31"),
        "Luminance-GS": _cells("14.06 0.59 0.14 14.87 0.72 0.18 14.51 0.66 0.32"),
        "4DGS": _cells("7.03 0.15 0.15 6.41 0.29 0.20 6.65 0.23 0.35"),
        "L2DGS": _cells("21.00 0.78 0.07 16.13 0.77 0.09 17.61 0.77 0.16"),
    },
    "handwavy": {
        "AlethNeRF": _cells("11.93 0.38 0.10 12.54 0.39 0.51 12.41 0.39 0.61"),
        "LLNeRF": _cells("11.33 0.42 0.05 13.15 0.54 0.24 12.78 0.52 0.29"),
        "LITA-GS": _cells("9.79 0.40 0.07 9.74 0.36 0.35 9.73 0.36 0.42"),
        "Luminance-GS": _cells("12.13 0.50 0.07 11.97 0.56 0.33 11.99 0.55 0.39"),
        "4DGS": _cells("5.86 0.04 0.09 5.75 0.06 0.44 5.77 0.06 0.53"),
        "L2DGS": _cells("12.21 0.51 0.04 12.21 0.62 0.22 11.72 0.58 0.26"),
    },
    "apple": {
        "AlethNeRF": _cells("4.89 0.04 0.16 6.30 0.04 0.47 5.89 0.04 0.63"),
        "LLNeRF": _cells("6.43 0.27 0.16 5.19 0.23 0.47 5.47 0.24 0.63"),
        "LITA-GS": _cells("10.22 0.24 0.12 9.37 0.25 0.38 9.48 0.25 0.51"),
        "Luminance-GS": _cells("12.22 0.32 0.11 12.62 0.47 0.33 12.50 0.43 0.44"),
        "4DGS": _cells("5.06 0.07 0.13 6.35 0.06 0.39 5.98 0.06 0.53"),
        "L2DGS": _cells("13.26 0.58 0.06 13.67 0.65 0.18 13.31 0.63 0.24"),
    },
    "creeper": {
        "AlethNeRF": _cells("6.85 0.02 0.43 5.07 0.02 0.23 6.15 0.02 0.66"),
        "LLNeRF": _cells("6.02 0.07 0.50 6.36 0.09 0.26 6.14 0.08 0.77"),
        "LITA-GS": _cells("11.76 0.49 0.03 11.37 0.56 0.19 11.44 0.55 0.23"),
        "Luminance-GS": _cells("11.48 0.30 0.16 14.50 0.48 0.08 12.30 0.36 0.24"),
        "4DGS": _cells("6.98 0.04 0.36 5.22 0.05 0.19 6.29 0.04 0.55"),
        "L2DGS": _cells("15.49 0.55 0.12 12.01 0.60 0.07 13.96 0.57 0.19"),
    },
}

# Table 3, by the names of the variants in studies/table3.toml.
TABLE3 = {
    "without_ssim": _cells("14.12 0.41 0.20 12.84 0.52 0.29 13.20 0.49 0.49"),
    "without_exposure": _cells("8.36 0.23 0.11 7.30 0.30 0.19 7.65 0.27 0.31"),
    "without_depth": _cells("16.26 0.56 0.11 13.57 0.61 0.14 14.27 0.60 0.25"),
    "without_structure": _cells("14.40 0.53 0.10 14.71 0.68 0.16 14.56 0.62 0.26"),
    "without_amplification": _cells("7.82 0.18 0.14 6.57 0.23 0.22 6.99 0.22 0.37"),
    "without_bafe_net": _cells("6.73 0.13 0.26 5.87 0.21 0.42 6.14 0.19 0.68"),
    "without_ocd_net": _cells("15.06 0.58 0.07 12.73 0.70 0.12 13.36 0.65 0.19"),
    "maximise_r_too": _cells("16.73 0.63 0.07 13.67 0.70 0.12 14.57 0.68 0.19"),
    "maximise_r_instead": _cells("7.74 0.17 0.18 6.45 0.22 0.23 6.89 0.21 0.37"),
    "b1_is_1": _cells("14.23 0.57 0.07 11.66 0.65 0.13 12.46 0.62 0.20"),
    "b2_is_1": _cells("12.59 0.41 0.11 12.95 0.57 0.16 12.54 0.51 0.27"),
    "whole": _cells("16.73 0.64 0.07 13.86 0.71 0.12 14.68 0.69 0.18"),
}

# From the last paragraph of section 5: scores of the estimate of the low-light input against that input.
LOWLIGHT: Figures = {
    "dynamic": {"psnr": 31.28, "ssim": 0.92},
    "static": {"psnr": 32.96, "ssim": 0.96},
    "overall": {"psnr": 31.86, "ssim": 0.94},
}

# Table 2: percent of choices and mean rating, by criterion (i) ... (v).
TABLE2 = {
    "AlethNeRF": ((0.00, 1.56), (0.01, 1.36), (0.10, 1.58), (0.10, 1.26), (0.01, 1.34)),
    "LLNeRF": ((23.14, 3.05), (2.01, 2.97), (1.12, 2.91), (25.80, 2.84), (6.03, 2.83)),
    "LITA-GS": ((1.64, 1.59), (0.18, 2.32), (2.95, 2.54), (1.74, 1.98), (6.33, 2.36)),
    "GS-DK": ((0.00, 2.09), (2.23, 2.21), (0.29, 2.03), (0.001, 2.13), (1.11, 2.02)),
    "Luminance-GS": ((0.02, 2.39), (2.01, 2.81), (1.10, 2.36), (0.001, 2.67), (6.11, 2.55)),
    "L2DGS": ((75.20, 4.05), (93.57, 4.33), (94.34, 4.08), (72.36, 4.36), (80.41, 4.28)),
}
