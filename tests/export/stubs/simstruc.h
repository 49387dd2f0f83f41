/* A stand-in for Simulink's simstruc.h: what an exported S-function uses of it, as functions with
 * the types that The MathWorks documents, and memory that tells what was set. */
#ifndef SIMSTRUC_STUB_H
#define SIMSTRUC_STUB_H

#include <stddef.h>

typedef double real_T;
typedef int int_T;
typedef unsigned int uint_T;

#define DYNAMICALLY_SIZED (-1)
#define STUB_PORTS 8
#define STUB_WIDTH 32

typedef struct {
    int_T parameters, inputs, outputs, sample_times, pointers, major;
    int_T in_width[STUB_PORTS], out_width[STUB_PORTS], direct[STUB_PORTS], contiguous[STUB_PORTS];
    real_T in[STUB_PORTS][STUB_WIDTH], out[STUB_PORTS][STUB_WIDTH];
    real_T period, offset;
    void *pointer;
    const char *error;
} SimStruct;

static inline void ssSetNumSFcnParams(SimStruct *S, int_T n) { S->parameters = n; }
static inline int_T ssGetNumSFcnParams(SimStruct *S) { return S->parameters; }
static inline int_T ssGetSFcnParamsCount(SimStruct *S) { (void)S; return 0; }
static inline int_T ssSetNumInputPorts(SimStruct *S, int_T n) { S->inputs = n; return 1; }
static inline int_T ssSetNumOutputPorts(SimStruct *S, int_T n) { S->outputs = n; return 1; }
static inline void ssSetInputPortWidth(SimStruct *S, int_T p, int_T w) { S->in_width[p] = w; }
static inline int_T ssGetInputPortWidth(SimStruct *S, int_T p) { return S->in_width[p]; }
static inline void ssSetOutputPortWidth(SimStruct *S, int_T p, int_T w) { S->out_width[p] = w; }
static inline void ssSetInputPortDirectFeedThrough(SimStruct *S, int_T p, int_T v) { S->direct[p] = v; }
static inline void ssSetInputPortRequiredContiguous(SimStruct *S, int_T p, int_T v) { S->contiguous[p] = v; }
static inline void ssSetNumSampleTimes(SimStruct *S, int_T n) { S->sample_times = n; }
static inline void ssSetNumPWork(SimStruct *S, int_T n) { S->pointers = n; }
static inline void ssSetSampleTime(SimStruct *S, int_T i, real_T t) { (void)i; S->period = t; }
static inline void ssSetOffsetTime(SimStruct *S, int_T i, real_T t) { (void)i; S->offset = t; }
static inline void ssSetErrorStatus(SimStruct *S, const char *words) { S->error = words; }
static inline void ssSetPWorkValue(SimStruct *S, int_T i, void *p) { (void)i; S->pointer = p; }
static inline void *ssGetPWorkValue(SimStruct *S, int_T i) { (void)i; return S->pointer; }
static inline int_T ssIsMajorTimeStep(SimStruct *S) { return S->major; }
static inline real_T *ssGetOutputPortRealSignal(SimStruct *S, int_T p) { return S->out[p]; }
static inline const real_T *ssGetInputPortRealSignal(SimStruct *S, int_T p) { return S->in[p]; }

#endif
