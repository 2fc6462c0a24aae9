/* What the program needs of a board: text out, a counter, and the stack that was used. */
#ifndef BOARD_H
#define BOARD_H

void put(const char *text);
unsigned ticks(void); /* counts down modulo 2^24 */
unsigned stack_used(void); /* bytes, the most so far */

#ifdef COUNTS_INSTRUCTIONS /* the emulator takes 64 ns for each instruction, the counter 40 ns for each tick */
#define COST(ticks) ((ticks) * 5u / 8u)
#else /* cycles of the processor */
#define COST(ticks) (ticks)
#endif

#endif
