/* Saving an instance, and derivatives: what FMI 3.0 leaves to choice and this FMU offers. */

#include <stdlib.h>
#include <string.h>

#include "instance.h"

/* ---- saving and restoring ------------------------------------------------------------------------------- */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    REQUIRE(ANY_PHASE & ~FAILED);
    if (!*state) *state = malloc(sizeof i->saved);
    if (!*state) return tell(i, fmi3Error, "no memory to save the instance.");
    memcpy(*state, &i->saved, sizeof i->saved);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state)
{
    REQUIRE(ANY_PHASE);
    memcpy(&i->saved, state, sizeof i->saved);
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
    (void)instance, (void)state;
    *size = sizeof(struct saved);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    REQUIRE(ANY_PHASE & ~FAILED);
    if (size != sizeof(struct saved)) return wrong_size(i, __func__, size, sizeof(struct saved));
    memcpy(bytes, state, size);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    REQUIRE(ANY_PHASE);
    if (size != sizeof(struct saved)) return wrong_size(i, __func__, size, sizeof(struct saved));
    if (memcmp(bytes, MODEL_TOKEN, sizeof MODEL_TOKEN) != 0)
        return tell(i, fmi3Error, "%s: the bytes were saved by another model.", __func__);
    if (!*state) *state = malloc(size);
    if (!*state) return tell(i, fmi3Error, "no memory to restore the instance.");
    memcpy(*state, bytes, size);
    return fmi3OK;
}

/* ---- derivatives ---------------------------------------------------------------------------------------- */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                        size_t n_unknowns, const fmi3ValueReference knowns[], size_t n_knowns,
                                        const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[],
                                        size_t n_sensitivity)
{
    REQUIRE(INITIALIZATION | RUNNING | TERMINATED);
    bool at_start = i->saved.phase == INITIALIZATION;
    struct direction d;
    if (n_seed != n_knowns) return wrong_size(i, __func__, n_seed, n_knowns);
    if (n_sensitivity != n_unknowns) return wrong_size(i, __func__, n_sensitivity, n_unknowns);
    fmi3Status status = refresh(i);
    if (status != fmi3OK) return status;
    memset(&d, 0, sizeof d);
    for (size_t k = 0; k < n_knowns; ++k) {
        int at;
        if ((at = within(knowns[k], FIRST_U, NU)) >= 0)
            d.u[at] += seed[k];
        else if (at_start && (at = within(knowns[k], FIRST_P, NP)) >= 0)
            d.p[at] += seed[k];
        else if (!at_start && (at = within(knowns[k], FIRST_X, NX)) >= 0)
            d.x[at] += seed[k];
        else if (!at_start && knowns[k] == TIME)
            d.t += seed[k];
        else
            return tell(i, fmi3Error, "%s: value reference %u is not known here.", __func__, knowns[k]);
    }
    if (at_start)
        hybrid_equilibrium_slope(&i->saved.now, &d);
    else
        hybrid_move(&i->saved.now, &d, true);
    for (size_t k = 0; k < n_unknowns; ++k) {
        int at;
        if ((at = within(unknowns[k], FIRST_F, NX)) >= 0)
            sensitivity[k] = d.f[at];
        else if ((at = within(unknowns[k], FIRST_Y, NY)) >= 0)
            sensitivity[k] = d.y[at];
        else if ((at = within(unknowns[k], FIRST_Z, NZ)) >= 0)
            sensitivity[k] = d.z[at];
        else if ((at = within(unknowns[k], FIRST_H, NH)) >= 0)
            sensitivity[k] = at < NROWS && !hybrid_active(&i->saved.now, at) ? 0.0 : d.h[at];
        else if (at_start && (at = within(unknowns[k], FIRST_X, NX)) >= 0)
            sensitivity[k] = d.x[at];
        else
            return tell(i, fmi3Error, "%s: value reference %u is not unknown here.", __func__, unknowns[k]);
    }
    return fmi3OK;
}
