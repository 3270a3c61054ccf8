/* Number of cases at once: as many doubles as one vector register of this processor holds. */
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
