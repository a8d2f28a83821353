"""Diagnosis of model errors: named causes from Kalman innovations, tested on held-out data.

The steps of a diagnosis, a folder each:

`data`        runs as arrays with the thrusters' commands and their scenarios (`arrays`); faults of
              the data: stuck sensors, jumps, axes never excited (`checks`); runs that had the same
              commands (`repeats`)
`filter`      motion of a model along the records (`along_records`), which predictions, forecasts
              and simulations share; one-step predictions from every sample, their errors r and
              Jacobians A (`innovations`); diffusion and measurement noise from their covariances,
              and the Kalman gain (`noise`); sensitivities of the innovations to every effect
              (`sensitivities`), inner products of these by run (`gram`); all of these at one θ
              (`problem`)
`candidates`  unmodelled structure: groups of further regressors for the wrench
`disturbance` laws of the residual: level, colour, heavy tails, waves, varying currents
`selection`   fits, held-out gains and tests of sets of causes (`hypotheses`); forward selection of
              causes in pure steps (`search`, `state`) by the rules of `model_selection`; joint fit
              of all coefficients (`refit_all`)
`validation`  scores on held-out data (`validation`): log scores, noise-free forecasts (`forecast`),
              simulations with noise (`simulation`), coverage of bands, and a black-box model to
              compare with (`blackbox`)
`findings`    causes with intervals, in words; `diagnosis.json` (`result`); the next experiment

`causes` has the order in which causes and structure are sought. `pipeline` runs all of these, from
a recording and a believed model to a `result.Diagnosis` (`result.schema()` is its JSON Schema).

The filter. A record y_n = h(x_n) + e_n is predicted from the record before it,
r_n = y_(n+1) ⊖ h(f(h⁻¹(y_n), u_n)), with f a fourth-order step under the held command. To first
order in the noise the innovations of the Kalman filter with gain K follow from these errors alone,

    ν_(n+1) = r_n + A_n (I - K_n) ν_n,

so samples are predicted independently, noise levels may be changed afterwards, and the sensitivity
of ν to an effect is the same linear recursion on the change that the effect makes in r. Under the
true model ν is white and independent of the past, sensitivities included: scores have no bias from
noisy regressors.
"""
