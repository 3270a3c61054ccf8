#include "instance.h"

#include <stdarg.h>
#include <stdio.h>

/* The place of `reference` in a block, or -1. */
int within(fmi3ValueReference reference, int first, int count)
{
    return reference >= (unsigned)first && reference < (unsigned)(first + count) ? (int)reference - first : -1;
}

fmi3Status tell(struct instance *i, fmi3Status status, const char *format, ...)
{
    static const char *const categories[] = {"logEvents", "logStatusWarning", "logStatusDiscard",
                                             "logStatusError", "logStatusError"};
    char text[4096];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    if (status == fmi3Error) i->saved.phase = FAILED;
    if (i->log && (status != fmi3OK || i->tells_events)) i->log(i->environment, status, categories[status], text);
    return status;
}

bool allowed(struct instance *i, int phases, const char *function)
{
    static const char *const names[] = {"before initialization", "in initialization mode", "in event mode",
                                        "in continuous-time mode", "after termination", "after an error"};
    int number = 0;
    if (i->saved.phase & phases) return true;
    while (i->saved.phase >> (number + 1)) ++number;
    tell(i, fmi3Error, "%s cannot be called %s.", function, names[number]);
    return false;
}

fmi3Status wrong_size(struct instance *i, const char *function, size_t given, size_t expected)
{
    return tell(i, fmi3Error, "%s: %zu values given, %zu expected.", function, given, expected);
}

/* Bring all values up to date: in initialization mode they are those of the equilibrium. */
fmi3Status refresh(struct instance *i)
{
    char text[2048];
    if (i->saved.phase == INITIALIZATION && !i->saved.at_start) {
        if (!hybrid_equilibrium(&i->saved.now, text, sizeof text)) return tell(i, fmi3Error, "%s", text);
        i->saved.at_start = true;
    }
    if (hybrid_evaluate(&i->saved.now)) return fmi3OK;
    hybrid_fault(&i->saved.now, text, sizeof text);
    return tell(i, fmi3Discard, "%s", text);
}
