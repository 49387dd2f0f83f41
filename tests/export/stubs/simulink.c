/* A stand-in for what Simulink puts behind an S-function: it does what the engine does, in its
 * order, with the width of the first input as the program's argument. Each line of numbers is one
 * period, the first input and then the second; the answer is all outputs. */
#include <stdio.h>
#include <stdlib.h>

int main(int count, char **words)
{
    static SimStruct S;
    const int_T width = count > 1 ? atoi(words[1]) : 0;
    mdlInitializeSizes(&S);
    if (ssGetInputPortWidth(&S, 0) != DYNAMICALLY_SIZED || S.outputs != 4 || S.pointers != 1) {
        return 3;
    }
    mdlSetOutputPortWidth(&S, 0, 9);
    if (S.error == NULL || S.out_width[0] == 9) {
        return 5; /* the widths of outputs are fixed */
    }
    S.error = NULL;
    mdlSetInputPortWidth(&S, 0, width);
    if (S.error != NULL) {
        puts(S.error);
        return 2;
    }
    mdlInitializeSampleTimes(&S);
    mdlStart(&S);
    printf("%.17g\n", S.period);
    for (;;) {
        for (int i = 0; i < width; i++) {
            if (scanf("%lf", &S.in[0][i]) != 1) {
                mdlTerminate(&S);
                return S.pointer != NULL || S.error != NULL;
            }
        }
        if (scanf("%lf", &S.in[1][0]) != 1) {
            return 4;
        }
        S.major = 1;
        mdlOutputs(&S, 0);
        S.major = 0; /* a minor step of a variable-step solver must change nothing */
        mdlOutputs(&S, 0);
        for (int port = 0; port < S.outputs; port++) {
            for (int i = 0; i < S.out_width[port]; i++) {
                printf("%.17g ", S.out[port][i]);
            }
        }
        printf("\n");
    }
}
