/* One instance of the FMU: what it holds, and what the functions of the interface share. */

#ifndef INSTANCE_H
#define INSTANCE_H

#include "fmi3/fmi3Functions.h"
#include "hybrid.h"

enum phase { INSTANTIATED = 1, INITIALIZATION = 2, EVENT = 4, CONTINUOUS = 8, TERMINATED = 16, FAILED = 32 };
#define RUNNING (EVENT | CONTINUOUS)
#define ANY_PHASE (INSTANTIATED | INITIALIZATION | RUNNING | TERMINATED | FAILED)

/* What is saved with an instance. */
struct saved {
    char token[sizeof MODEL_TOKEN];
    enum phase phase;
    bool at_start; /* x and z are those of the present inputs and parameters: matters in INITIALIZATION */
    struct hybrid now;
};

struct instance {
    struct saved saved;
    bool tells_events;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
};

/* Value references: one block after the other, as in modelDescription.xml. */
enum {
    TIME,
    FIRST_X,
    FIRST_F = FIRST_X + NX,
    FIRST_U = FIRST_F + NX,
    FIRST_P = FIRST_U + NU,
    FIRST_Y = FIRST_P + NP,
    FIRST_Z = FIRST_Y + NY,
    FIRST_H = FIRST_Z + NZ,
    FIRST_MODE = FIRST_H + NH,
    END = FIRST_MODE + NA
};

int within(fmi3ValueReference reference, int first, int count);
fmi3Status tell(struct instance *i, fmi3Status status, const char *format, ...);
bool allowed(struct instance *i, int phases, const char *function);
fmi3Status wrong_size(struct instance *i, const char *function, size_t given, size_t expected);
fmi3Status refresh(struct instance *i);

#define REQUIRE(phases) \
    struct instance *i = instance; \
    if (!allowed(i, phases, __func__)) return fmi3Error

#endif
