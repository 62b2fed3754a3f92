// Debug checks.
#pragma once

#include <cstdio>
#include <cstdlib>

// A broken invariant is a bug of ours: it stops a debug build. User errors are raised in Python.
#ifdef UNIVOXEL_DEBUG
#define DCHECK(condition)                                                                \
    do {                                                                                 \
        if (!(condition)) {                                                              \
            std::fprintf(stderr, "%s:%d: DCHECK(%s)\n", __FILE__, __LINE__, #condition); \
            std::abort();                                                                \
        }                                                                                \
    } while (false)
#else
#define DCHECK(condition) ((void)0)
#endif
