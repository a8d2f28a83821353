"""What a simulation gets wrong, by name: innovations, probes, held-out scores.

The steps of a diagnosis, a folder each:

`data`        runs as arrays with the thrusters' commands and their scenarios (`arrays`); faults of
              the data: stuck sensors, jumps, axes never excited (`checks`); runs that had the same
              commands (`repeats`)
`filter`      one-step predictions from every sample, their errors r and Jacobians A
              (`innovations`); diffusion and measurement noise from their covariances, and the
              Kalman gain (`noise`); how every effect would change the innovations
              (`sensitivities`), inner products of these by run (`gram`); all of it for one set of
              parameters (`problem`)
`candidates`  structure without a name: what a wrench could depend on besides, group by group
`disturbance` laws of what is left: level, memory, heavy tails, waves, varying currents
`selection`   fits, held-out gains and bounds of sets of causes (`hypotheses`); which causes are
              there together (`search`); which name to give (`model_selection`); fits to forecasts
              for states that were smoothed or resampled (`multi_step_fit`); all coefficients anew
              (`refit_all`)
`validation`  what a model is worth on data left out: scores, simulations, bands, and a rival that
              names nothing (`blackbox`)
`findings`    causes with intervals, in words; `diagnosis.json` (`result`); the next experiment

`pipeline` does all of it, from a recording and a belief to a `result.Diagnosis` (`result.schema()`
is its JSON Schema).

The filter. A record y_n = h(x_n) + e_n is predicted from the record before it,
r_n = y_(n+1) ⊖ h(f(h⁻¹(y_n), u_n)), with f a fourth-order step under the held command. To first
order in the noise the innovations of the Kalman filter with gain K follow from these errors alone,

    ν_(n+1) = r_n + A_n (I - K_n) ν_n,

so predictions need no sequence, noise levels may be changed afterwards, and the response of ν to
an effect is the same linear recursion on the change that the effect makes in r. At the truth ν
is white and independent of everything in the past, responses included: scores have no bias from
noisy regressors.
"""
