#include <math.h>
#include "${name}_vectors.h"
unsigned long ut_size(void);
void ut_begin(ut_controller *c);
void ut_replay(ut_controller *c, const ut_real *q, ut_real *u, long count);
unsigned long ut_size(void)
{
    return sizeof(ut_controller);
}
void ut_begin(ut_controller *c)
{
    ut_init(c);
    (void)ut_offer(c, &ut_next_plan);
}
void ut_replay(ut_controller *c, const ut_real *q, ut_real *u, long count)
{
    for (long k = 0; k < count; k++) {
        (void)ut_step(c, q + k * UT_N, u + k * UT_M);
    }
}
