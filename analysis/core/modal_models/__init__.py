"""Modal models with common poles, fitted to curves: initial poles, least squares, and selection of the order.

`lscf` estimates the initial poles, `pole_residue` fits a model, and `order_selection` adds the significant poles. No
module of this package reads recordings.
"""
