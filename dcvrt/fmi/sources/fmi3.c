/* The FMI 3.0 model-exchange interface of a hybrid system: what the standard asks for, put in terms of hybrid.h. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

/* ---- life of an instance -------------------------------------------------------------------------------- */

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    REQUIRE(ANY_PHASE);
    bool meant = n == 0;
    for (size_t k = 0; k < n; ++k) meant = meant || strcmp(categories[k], "logEvents") == 0;
    if (meant) i->tells_events = on; /* warnings and errors are always told */
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name, (void)resources, (void)visible;
    if (!token || strcmp(token, MODEL_TOKEN) != 0) {
        if (log)
            log(environment, fmi3Error, "logStatusError",
                "The instantiation token is not that of this binary: modelDescription.xml belongs to another one.");
        return NULL;
    }
    struct instance *i = calloc(1, sizeof *i);
    if (!i) return NULL;
    memcpy(i->saved.token, MODEL_TOKEN, sizeof MODEL_TOKEN);
    i->environment = environment;
    i->log = log;
    i->tells_events = logging;
    i->saved.phase = INSTANTIATED;
    hybrid_defaults(&i->saved.now);
    return i;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop)
{
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    REQUIRE(INSTANTIATED);
    i->saved.now.t = start;
    hybrid_begin(&i->saved.now);
    i->saved.at_start = false;
    i->saved.phase = INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    REQUIRE(INITIALIZATION);
    char text[2048];
    if (!hybrid_together(&i->saved.now, text, sizeof text)) return tell(i, fmi3Error, "%s", text);
    if (refresh(i) != fmi3OK) {
        i->saved.phase = FAILED;
        return fmi3Error;
    }
    hybrid_begin(&i->saved.now);
    i->saved.phase = EVENT;
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    REQUIRE(RUNNING);
    i->saved.phase = EVENT;
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    REQUIRE(EVENT);
    i->saved.phase = CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    REQUIRE(RUNNING);
    i->saved.phase = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    REQUIRE(ANY_PHASE);
    hybrid_defaults(&i->saved.now);
    i->saved.at_start = false;
    i->saved.phase = INSTANTIATED;
    return fmi3OK;
}

/* ---- variables ------------------------------------------------------------------------------------------ */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                          fmi3Float64 values[], size_t n_values)
{
    REQUIRE(ANY_PHASE & ~FAILED);
    struct hybrid *now = &i->saved.now;
    fmi3Status status = fmi3OK;
    if (n != n_values) return wrong_size(i, __func__, n_values, n);
    for (size_t k = 0; k < n; ++k) {
        fmi3ValueReference r = references[k];
        bool given = r == TIME || within(r, FIRST_U, NU + NP) >= 0;
        if (!given && i->saved.phase == INSTANTIATED)
            return tell(i, fmi3Error, "%s: value reference %u has no value before initialization.", __func__, r);
        if (!given && status == fmi3OK && (status = refresh(i)) == fmi3Error) return status;
        int at;
        if (r == TIME)
            values[k] = now->t;
        else if ((at = within(r, FIRST_X, NX)) >= 0)
            values[k] = now->x[at];
        else if ((at = within(r, FIRST_F, NX)) >= 0)
            values[k] = now->f[at];
        else if ((at = within(r, FIRST_U, NU)) >= 0)
            values[k] = now->u[at];
        else if ((at = within(r, FIRST_P, NP)) >= 0)
            values[k] = now->p[at];
        else if ((at = within(r, FIRST_Y, NY)) >= 0)
            values[k] = now->y[at];
        else if ((at = within(r, FIRST_Z, NZ)) >= 0)
            values[k] = now->z[at];
        else if ((at = within(r, FIRST_H, NH)) >= 0)
            values[k] = hybrid_indicator(now, at);
        else
            return tell(i, fmi3Error, "%s: there is no Float64 variable with value reference %u.", __func__, r);
    }
    return status;
}

static fmi3Status set_parameter(struct instance *i, int at, double value)
{
    const struct parameter *p = &model_parameters[at];
    if (!(i->saved.phase & (INSTANTIATED | INITIALIZATION)))
        return tell(i, fmi3Error, "%s is fixed: set it before the end of the initialization.", p->name);
    if (!(p->low <= value && value <= p->high))
        return tell(i, fmi3Error, "%s = %g %s is outside [%g, %g].", p->name, value, p->unit, p->low, p->high);
    i->saved.now.p[at] = value;
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                          const fmi3Float64 values[], size_t n_values)
{
    REQUIRE(INSTANTIATED | INITIALIZATION | RUNNING);
    if (n != n_values) return wrong_size(i, __func__, n_values, n);
    i->saved.now.known = false;
    i->saved.at_start = false;
    for (size_t k = 0; k < n; ++k) {
        int at;
        if ((at = within(references[k], FIRST_U, NU)) >= 0) {
            if (!isfinite(values[k]))
                return tell(i, fmi3Error, "the input %s was set to %g at %.6g s.", model_inputs[at].name, values[k],
                            i->saved.now.t);
            i->saved.now.u[at] = values[k];
        } else if ((at = within(references[k], FIRST_P, NP)) >= 0) {
            if (set_parameter(i, at, values[k]) != fmi3OK) return fmi3Error;
        } else {
            return tell(i, fmi3Error, "%s: value reference %u is neither an input nor a parameter.", __func__,
                        references[k]);
        }
    }
    return fmi3OK;
}

/* Enumerations, that is the modes, travel as Int64. */
fmi3Status fmi3GetInt64(fmi3Instance instance, const fmi3ValueReference references[], size_t n, fmi3Int64 values[],
                        size_t n_values)
{
    REQUIRE(ANY_PHASE & ~(INSTANTIATED | FAILED));
    if (n != n_values) return wrong_size(i, __func__, n_values, n);
    if (n > 0 && refresh(i) == fmi3Error) return fmi3Error;
    for (size_t k = 0; k < n; ++k) {
        int at = within(references[k], FIRST_MODE, NA);
        if (at < 0)
            return tell(i, fmi3Error, "%s: there is no enumeration with value reference %u.", __func__,
                        references[k]);
        values[k] = i->saved.now.mode[at];
    }
    return fmi3OK;
}

/* ---- continuous time ------------------------------------------------------------------------------------ */

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time)
{
    REQUIRE(RUNNING);
    i->saved.now.t = time;
    i->saved.now.known = false;
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 states[], size_t n)
{
    REQUIRE(RUNNING);
    if (n != NX) return wrong_size(i, __func__, n, NX);
    memcpy(i->saved.now.x, states, n * sizeof *states);
    i->saved.now.known = false;
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 states[], size_t n)
{
    REQUIRE(INITIALIZATION | RUNNING | TERMINATED);
    if (n != NX) return wrong_size(i, __func__, n, NX);
    fmi3Status status = refresh(i);
    memcpy(states, i->saved.now.x, n * sizeof *states);
    return status == fmi3Error ? status : fmi3OK; /* a state that was set can be read back, whatever it does */
}

/* Values that are no numbers are handed over too: a tool that overlooks the status shall not go on with old ones. */
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t n)
{
    REQUIRE(INITIALIZATION | RUNNING | TERMINATED);
    if (n != NX) return wrong_size(i, __func__, n, NX);
    fmi3Status status = refresh(i);
    memcpy(derivatives, i->saved.now.f, n * sizeof *derivatives);
    return status;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t n)
{
    REQUIRE(INITIALIZATION | RUNNING | TERMINATED);
    if (n != NH) return wrong_size(i, __func__, n, NH);
    fmi3Status status = refresh(i);
    for (int k = 0; k < NH; ++k) indicators[k] = hybrid_indicator(&i->saved.now, k);
    return status;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t n)
{
    REQUIRE(ANY_PHASE & ~FAILED);
    if (n != NX) return wrong_size(i, __func__, n, NX);
    memcpy(nominals, model_nominals, n * sizeof *nominals);
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *n)
{
    (void)instance;
    *n = NX;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *n)
{
    (void)instance;
    *n = NH;
    return fmi3OK;
}

/* ---- events --------------------------------------------------------------------------------------------- */

/* A safety net for tools that do not locate zeros of the indicators: they hear of an event at the end of a step. */
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean final, fmi3Boolean *event,
                                       fmi3Boolean *terminate)
{
    (void)final;
    REQUIRE(CONTINUOUS);
    fmi3Status status = refresh(i);
    *event = status == fmi3OK && hybrid_due(&i->saved.now);
    *terminate = false;
    return status;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *timed, fmi3Float64 *next)
{
    REQUIRE(EVENT);
    char text[4096];
    bool reset = false;
    fmi3Status status = refresh(i);
    *again = *terminate = *nominals_changed = *states_changed = *timed = false;
    if (status != fmi3OK) return status;
    switch (hybrid_update(&i->saved.now, &reset, text, sizeof text)) {
    case JUMPED:
        *again = true;
        *states_changed = reset;
        tell(i, fmi3OK, "%s", text);
        break;
    case LEFT_BOUNDS:
        *terminate = true;
        status = tell(i, fmi3Warning, "%s", text);
        break;
    case CHATTERS:
        return tell(i, fmi3Error, "%s", text);
    default:
        break;
    }
    double t;
    if (hybrid_next_timer(&i->saved.now, &t)) {
        *timed = true;
        *next = t;
    }
    return status;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    REQUIRE(INITIALIZATION | EVENT);
    return fmi3OK; /* modes change in fmi3UpdateDiscreteStates only */
}
