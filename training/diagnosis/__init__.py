"""What a simulation gets wrong, by name: innovations, probes, held-out scores.

The way of a diagnosis, one module a step:

`data`        runs as arrays, with the thrusters' commands and who belongs to which scenario
`innovations` one-step predictions from every sample, their errors r and Jacobians A
`noise`       diffusion and measurement noise from the errors' covariances; the Kalman gain
`responses`   how every effect would change the innovations: finite probes through the same filter
`gram`        inner products of innovations and responses, run by run
`hypotheses`  fits, held-out gains and bounds of a set of causes from these inner products
`naming`      which of them to give: vetoes, nesting, echoes, ties
`looking`     all that one set of parameters shows, and fits with exact predictions
`search`      which causes are there together: forward and backward
`structures`  what a wrench could depend on besides, group by group
`unknowns`    when to say that no name explains it
`laws`        what is left: heavy tails, memory, dependence on speed
`checks`      data at fault: stuck sensors, jumps, axes never excited
`gain`        what a model is worth on data left out: scores, simulations, bands
`blackbox`    a rival that names nothing: ridge regression on random features
`horizon`     fits to forecasts, for states that were smoothed, binned or resampled
`telling`     causes with intervals, in words
`diagnose`    all of it, to a `result.Diagnosis` (`result.schema()` is its JSON Schema)

The filter. A record y_n = h(x_n) + e_n is predicted from the record before it,
r_n = y_(n+1) ⊖ h(f(h⁻¹(y_n), u_n)), with f a fourth-order step under the held command. To first
order in the noise the innovations of the Kalman filter with gain K follow from these errors alone,

    ν_(n+1) = r_n + A_n (I - K_n) ν_n,

so predictions need no sequence, noise levels may be changed afterwards, and the response of ν to
an effect is the same linear recursion on the change that the effect makes in r. At the truth ν
is white and independent of everything in the past, responses included: scores have no bias from
noisy regressors.
"""
